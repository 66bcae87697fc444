"""Sums of blending weights over the pixels of a view, each pixel multiplied by a value that depends on the image."""

import argparse
from collections.abc import Callable

import torch
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import gradients_of
from diff_gaussian_rasterization.scene import draw, scene_arguments
from torch import Tensor

from gaussian_renderer import model_inputs, rasterizer_settings
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from splatting.distributed.rendering.band import draw_view, gradient_rows, whole_image
from splatting.distributed.rendering.models import ranks_of

_ONLY_COLORS = [name == "colors" for name in ("means2d", *Gaussians._fields)]


@torch.no_grad()
def weighted_sums(
    camera: Camera | MiniCam,
    gaussians: GaussianModel,
    pipe: argparse.Namespace,
    background: Tensor,
    value: Callable[[Tensor], Tensor],
) -> Tensor:
    """Sum over the pixels of each Gaussian's blending weight, alpha times transmittance, times three values: (N, 3).

    value: takes the image (3, H, W), not clamped, over background (3,), and returns values (3, H, W) float32.
    An image is linear in the Gaussians' colours and the weight is its derivative, so the backward of the rasterizer
    sums them. It gets what the forward has drawn, and is told that the colours were given, whatever their values.
    """
    geometry, raw, colors = model_inputs(camera, gaussians, pipe)
    settings, xyz = rasterizer_settings(camera, gaussians, pipe, background), gaussians.get_xyz
    drawn = scene_arguments(Gaussians(xyz, **geometry, **colors), settings, raw)
    given = scene_arguments(Gaussians(xyz, **geometry, colors=xyz), settings, raw)
    if (ranks := ranks_of(gaussians)).several:
        view = whole_image(draw_view(ranks, drawn, background, want_depth=False, train=True))
        rows = gradient_rows(view, (value(view.color), None, None), absolute=False)
        source, planes = (view.splats, view.tile_counts, *rows), ()
    else:
        image = draw(drawn, background)
        source, planes = image.kept(background), (value(image.color), None, None)
    (gradient,) = filter(torch.is_tensor, gradients_of(given, source, planes, _ONLY_COLORS))
    return gradient
