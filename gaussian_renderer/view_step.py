"""A view's image and the Gaussians' step that follows from it, without gradients of parameters in between.

For a training loop that needs no autograd through the Gaussians: `draw` renders a view, any function of the image is
differentiated by it, and `step` takes the optimiser's step inside the rasterizer's backward. Values, averages and
statistics get the same bits as by `render`, backward, `observe` and the optimiser's own step.
"""

import argparse
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import scene_arguments
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
    scene: tuple[Any, ...]  # arguments of the operators
    state: tuple[Tensor, ...] = ()
    more: tuple[Tensor, ...] = ()  # what the backward wants after the image's gradients
    view: View | None = None  # of several ranks, which have the state
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
    color, transmittance, depth, radii, splats, tile_counts, *lists, last, layers = OPERATORS.rasterize(
        rows.means, *scene, background, want_depth, True
    )
    state = (splats, *lists, background, last, transmittance)
    return Drawn(color, depth if want_depth else None, radii, scene, state, (tile_counts, layers))


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
    further = {"now": now, "absolute": absolute, **adam.penalties()}
    if (view := drawn.view) is not None:
        rows = gradient_rows(view, (image_gradient, None, depth_gradient), absolute)
        OPERATORS.rows_vjp_step_(
            *drawn.scene, view.splats, view.tile_counts, *rows, drawn.radii, *adam.arguments(observe), **further
        )
        return
    OPERATORS.rasterize_vjp_step_(
        *drawn.scene, *drawn.state, image_gradient, None, depth_gradient, *drawn.more, drawn.radii,
        *adam.arguments(observe), **further,
    )  # fmt: skip
