"""Median depth of a view: the depth at which half of a ray's light is absorbed.

The Gaussians of a view are divided by their depths into slabs of equal numbers. An image is linear in what Gaussians
carry, so one image of two channels a slab has the sums of its blending weights, and of weights times depths. The slab
in which the weights from the front reach one half has the median, and its mean is the depth. At a single pixel, all
weights are known.
"""

import argparse
from typing import NamedTuple

import torch
from torch import Tensor

from gaussian_renderer import draw, render
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel

SLABS = 32
_HALF = 0.5  # of the light


class Surface(NamedTuple):
    """A view of surfaces: depth (H, W) float32 along its axis, in the world's unit, and color (3, H, W) in [0, 1].

    The depth is 0 where less than half of the light is absorbed.
    """

    depth: Tensor
    color: Tensor


@torch.no_grad()
def surface_of(camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace) -> Surface:
    """Draw the median depth (H, W) and the colours (3, H, W), over black, of a view by a pinhole camera.

    pipe: the pipeline options.
    """
    means = gaussians.get_xyz
    clip = means @ camera.full_proj_transform[:, [0, 1, 3]][:3] + camera.full_proj_transform[3, [0, 1, 3]]
    depths = clip[:, 2].contiguous()
    ahead = depths > 0
    within = ahead & (clip[:, :2].abs() < depths[:, None]).all(1)
    seen = depths[within if within.any() else ahead].sort().values  # a Gaussian may reach it from beside
    if not len(seen):
        size = camera.image_height, camera.image_width
        return Surface(means.new_zeros(size), means.new_zeros(3, *size))
    slabs = torch.bucketize(depths, seen[torch.arange(1, SLABS, device=seen.device) * len(seen) // SLABS])
    features = means.new_zeros(len(means), SLABS, 2)
    rows = torch.arange(len(means), device=means.device)
    features[rows, slabs, 0], features[rows, slabs, 1] = 1, depths
    options = {"want_depth": False, "want_visibility": False, "features": features.flatten(1)}
    drawn = render(camera, gaussians, pipe, means.new_zeros(3), **options)
    return Surface(_compute_median(*drawn["features"].unflatten(0, (SLABS, 2)).unbind(1)), drawn["render"])


def _compute_median(weights: Tensor, depths: Tensor) -> Tensor:
    """Compute the median depth (H, W) from the sums (SLABS, H, W) of weights, and of weights times depths."""
    reached = weights.cumsum(0)
    found = (reached < _HALF).sum(0, keepdim=True).clamp_max(SLABS - 1)
    mean = depths.gather(0, found) / weights.gather(0, found)
    return torch.where(reached[-1] < _HALF, 0, mean[0])


@torch.no_grad()
def median_at(
    camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace, column: int, row: int
) -> float:
    """The median depth at one pixel, as in `Surface`, by the weights of all Gaussians that reach it."""
    means = gaussians.get_xyz
    drawn = draw(camera, gaussians, pipe, means.new_zeros(3))
    pixel = torch.zeros_like(drawn.image)
    pixel[:, row, column] = 1
    weights = drawn.color_gradient(pixel)[:, 0]  # the image is linear in colours
    found = weights.nonzero()[:, 0]
    along = camera.full_proj_transform[:, 3]
    depths, order = (means[found] @ along[:3] + along[3]).sort(stable=True)
    reached = weights[found[order]].cumsum(0) >= _HALF
    return float(depths[reached.int().argmax()]) if reached.any() else 0.0
