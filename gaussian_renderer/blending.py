"""Sums of blending weights of Gaussians, over a view's pixels or over its Gaussians.

An image is linear in the Gaussians' colours, and a blending weight, alpha times transmittance, is its derivative. So
the backward of the rasterizer sums weights over pixels, and an image of other colours sums them over Gaussians.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gaussian_renderer import draw, render
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel


class Plane(NamedTuple):
    """A plane of `view_planes` that render.py writes as 16-bit PNGs."""

    what: str  # in the option's help
    white: float | None  # value of white; None: the largest of each view


PLANES = {"depth": Plane("inverse depth", None), "alpha": Plane("alpha", 1.0)}


@torch.no_grad()
def weighted_sums(
    camera: Camera | MiniCam,
    gaussians: GaussianModel,
    pipe: argparse.Namespace,
    background: Tensor,
    value: Callable[[Tensor], Tensor],
) -> Tensor:
    """Sum over the pixels of each Gaussian's blending weight times three values: (N, 3).

    value: takes the image (3, H, W), not clamped, over background (3,), and returns values (3, H, W) float32.
    """
    drawn = draw(camera, gaussians, pipe, background)
    return drawn.color_gradient(value(drawn.image))


@torch.no_grad()
def view_planes(
    camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace, scaling: float = 1.0
) -> dict[str, Tensor]:
    """`depth` and `alpha` of a view, (1, H, W) float32 each, by the weights w_i of the image's Gaussians.

    depth: inverse depth, the sum of w_i / z_i, per world unit; z_i is the depth of a mean. Divided by alpha, it is the
    mean inverse depth of the visible Gaussians.
    alpha: the sum of w_i, in [0, 1].

    scaling: factor of all scales.
    """
    white = gaussians.get_xyz.new_ones(len(gaussians), 3)
    black = gaussians.get_xyz.new_zeros(3)
    options = {"override_color": white, "want_depth": True, "want_visibility": False}
    drawn = render(camera, gaussians, pipe, black, scaling, **options)
    return {"depth": drawn["depth"], "alpha": drawn["render"][:1]}


def count_list_entries(
    camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace, scaling: float = 1.0
) -> Tensor:
    """Count for each pixel the Gaussians that its tile lists, up to the last one that is blended: (H, W) int32.

    The count is the work of the pixel: Gaussians of the list that miss the pixel count, too.

    scaling: factor of all scales.
    """
    return draw(camera, gaussians, pipe, gaussians.get_xyz.new_zeros(3), scaling=scaling).blend_depth
