"""A view's image and the Gaussians' step that follows from it, without gradients of parameters in between.

For a training loop that needs no autograd through the Gaussians: `draw` renders a view, any function of the image is
differentiated by it, and `step` takes the optimiser's step inside the rasterizer's backward. Values, averages and
statistics get the same bits as by `render`, backward, `observe` and the optimiser's own step.
"""

import argparse
from dataclasses import dataclass
from functools import partial

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.scene import Scene, scene_arguments
from diff_gaussian_rasterization.scene import draw as rasterize
from torch import Tensor

from gaussian_renderer import rasterizer_settings
from scene.cameras import Camera
from scene.fused_adam import FusedAdam
from scene.gaussian_model import GaussianModel
from splatting.distributed.rendering.band import (
    Band,
    View,
    draw_view,
    gradient_rows,
    surroundings,
    whole_image,
)
from splatting.distributed.rendering.bands import KnownBands
from splatting.distributed.rendering.models import ranks_of


@dataclass(slots=True)
class Drawn:
    """A view's image (3, H, W) and, if wanted, inverse depth (1, H, W); both may be given `requires_grad`.

    The image's gradient needs no more rows than the image has.
    """

    image: Tensor
    depth: Tensor | None
    radii: Tensor  # (N,) int32 pixels
    scene: Scene
    kept: tuple[Tensor, ...] = ()  # what the backward needs
    view: View | None = None  # of several ranks, in place of what is kept
    band: Band | None = None  # if the image is right only there and around it


@torch.no_grad()
def draw(
    camera: Camera,
    gaussians: GaussianModel,
    pipe: argparse.Namespace,
    background: Tensor,
    want_depth: bool,
    by_bands: bool = False,
    bands: KnownBands | None = None,
) -> Drawn:
    """Render a view for `step`. The Gaussians must be ones that `FusedAdam` takes.

    Of a model that is divided among ranks: by_bands: each needs no more of the image than the loss of its band. bands:
    those of earlier steps, in which the camera's uid stands for the view.
    """
    colors = {"sh_dc": gaussians.get_features_dc, "sh_rest": gaussians.get_features_rest}
    rows = Gaussians(gaussians.get_xyz, **gaussians.raw_geometry(), **colors)
    scene = scene_arguments(rows, rasterizer_settings(camera, gaussians, pipe, background), True)
    if (ranks := ranks_of(gaussians)).several:
        find = bands and partial(bands.find, camera.uid)
        view = draw_view(ranks, scene, background, want_depth, train=True, find=find)
        if bands:
            bands.drawn(camera.uid, view.last)
        view = surroundings(view) if by_bands else whole_image(view)
        depth = view.inverse_depth if want_depth else None
        return Drawn(view.color, depth, view.radii, scene, view=view, band=view.band if by_bands else None)
    drawn = rasterize(scene, background, want_depth)
    depth = drawn.inverse_depth if want_depth else None
    return Drawn(drawn.color, depth, drawn.radii, scene, drawn.kept(background))


@torch.no_grad()
def step(
    drawn: Drawn,
    adam: FusedAdam,
    image_gradient: Tensor,
    depth_gradient: Tensor | None,
    observe: bool,
    absolute: bool = False,
    now: Tensor | None = None,
) -> None:
    """Take the step of every Gaussian. observe: add the view to the statistics of density control.

    absolute: with the lengths of absolute gradients (`rasterize` of diff_gaussian_rasterization).
    now: (NOW_WORDS,) int64 on the Gaussians' device of `FusedAdam.write_now`, for a step that is recorded.
    """
    absolute &= observe
    planes = image_gradient, None, depth_gradient
    source = drawn.kept
    if (view := drawn.view) is not None:
        source = view.splats, view.tile_counts, *gradient_rows(view, planes, absolute)
        planes = ()
    # By place: names would cost the operator microseconds.
    OPERATORS.apply_gradients_(
        *drawn.scene.lists, source, planes, [], drawn.radii, *adam.arguments(observe), now, absolute
    )
