"""The oracle: 3D Gaussian Splatting (Kerbl et al. 2023) in plain float64 PyTorch; autograd differentiates it.

Start with `render`, which names the steps, then read camera, lens, shape, ray, colour and blend in this order. The
oracle shares no code with csrc and decides in disputes. It has no tiles: every Gaussian is evaluated at every pixel, so
it needs some 100 bytes for each Gaussian and pixel of the rows rendered at once.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.reference.blend import blend_rows, nearest_first
from diff_gaussian_rasterization.reference.camera import camera_of, project
from diff_gaussian_rasterization.reference.colour import seen_colors
from diff_gaussian_rasterization.reference.lens import rays
from diff_gaussian_rasterization.reference.ray import ray_shapes
from diff_gaussian_rasterization.reference.shape import activated, compensation, project_shapes, radii
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

__all__ = ["Rendered", "render"]


class Rendered(NamedTuple):
    """The result of `render`, float64 unless stated."""

    color: Tensor  # (3, H, W), background included
    radii: Tensor  # (N,) int32 px
    inverse_depth: Tensor  # (1, H, W): sum of alpha T / z
    transmittance: Tensor  # (1, H, W)
    near_cut: Tensor  # (H, W) bool: within `cut` (relative) of a cut-off or a depth tie, where rounding may decide


@lists_gaussians
def render(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    raw: bool = False,
    rows_at_once: int = 32,
    cut: float = 1e-4,
    **others: Tensor | None,
) -> Rendered:
    """Renders Gaussians by the definition that `rasterize` is held to; same arguments, any float dtype, all finite.

    others: the further fields of `Gaussians`. rows_at_once: image rows in memory at a time. cut: see `Rendered`.
    """
    given = Gaussians(means, opacities, **others)
    gaussians = Gaussians(*(None if values is None else values.double() for values in given))
    if raw:
        gaussians = activated(gaussians)
    camera = camera_of(settings)

    points = project(gaussians.means, means2d.double(), camera)
    ellipses = project_shapes(gaussians, points, camera, settings.scale_modifier)
    shapes, slopes, directions = ellipses, None, None
    if settings.projection == "ray":
        shapes, slopes = ray_shapes(gaussians, points, camera, settings.scale_modifier)
        directions = camera.lens and rays(camera.lens, camera.width, camera.height)
    opacity = gaussians.opacities.reshape(-1)
    if settings.antialiasing:
        opacity = opacity * compensation(shapes)
    colors = gaussians.colors if gaussians.colors is not None else seen_colors(gaussians, camera, settings.sh_degree)

    splats = nearest_first(points, shapes, slopes, opacity, colors, cut)
    starts = range(0, camera.height, rows_at_once)
    strips = [range(start, min(start + rows_at_once, camera.height)) for start in starts]
    background = settings.bg.double()
    parts = [blend_rows(splats, background, directions, rows, camera.width, cut) for rows in strips]
    color, inverse_depth, transmittance, near_cut = (torch.cat(planes, -2) for planes in zip(*parts, strict=True))
    return Rendered(color, radii(points, ellipses, camera), inverse_depth[None], transmittance[None], near_cut)
