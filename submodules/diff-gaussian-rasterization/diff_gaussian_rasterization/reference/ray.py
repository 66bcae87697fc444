"""Gaussians on rays (Huang et al. 2026, 3DGEER): a pixel's alpha is that of its own ray, without EWA's affine map.

On a ray from the camera, a Gaussian is largest where exp(-D^2 / 2) = 1 at best, D the ray's least Mahalanobis distance
from the mean. Write points as (x, y) px and the logarithm of the depth, linear around the mean. There the covariance is
((C, k), (k, c)), and C gets EWA's dilation: a Gaussian grows by 0.3 px^2 at its own depth. A pixel's ray has the offset
d from the mean, on the image linear around it. With g = -C^-1 k, s = 1 + g d, and e = c - k C^-1 k,

    D^2 = q / (s^2 + e q),   q = d C^-1 d

s > 0 says that the largest value lies in front of the camera. q is EWA's exponent: small Gaussians have k = 0 and
c = 0, and look as with EWA. No scale is divided by, so that flat Gaussians are nothing special.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.reference.camera import Camera, Points, jacobians
from diff_gaussian_rasterization.reference.shape import Ellipses, ellipses_of, in_space


class Slopes(NamedTuple):
    """Further values of N Gaussians that rays need besides their ellipses."""

    g: Tensor  # (N, 2) per px
    e: Tensor  # (N,) squared deviation along the ray, over the squared depth
    rows: Tensor | None  # (N, 3, 3) of a ray's direction its offset, px, and its depth; None for a pinhole


def ray_shapes(gaussians: Gaussians, points: Points, camera: Camera, scale_modifier: float) -> tuple[Ellipses, Slopes]:
    """Return the ellipses of the covariances C, and the slopes."""
    J, depth = jacobians(points, camera), points.depth[:, None]
    if camera.lens is None or camera.lens.chart == "perspective":
        by_depth = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(len(depth), 3)
    else:
        by_depth = points.view / depth
    rows = torch.cat([J, (by_depth / depth)[:, None]], 1) @ camera.world_to_view[:3, :3].T
    ellipses = ellipses_of(rows[:, :2], *(shape := in_space(gaussians, scale_modifier)), camera.dilation)
    half, Sigma = shape
    Sigma = rows @ Sigma @ rows.transpose(1, 2) if half is None else (rows @ half) @ (rows @ half).transpose(1, 2)
    k, c = Sigma[:, :2, 2], Sigma[:, 2, 2]
    first = k[:, 0] / ellipses.r11  # R^-T k, with C = R^T R
    second = (k[:, 1] - ellipses.r12 * first) / ellipses.r22
    g2 = -second / ellipses.r22
    g1 = (-first - ellipses.r12 * g2) / ellipses.r11
    of_rays = None
    if camera.lens is not None:
        shift = torch.cat([points.shift, torch.zeros_like(depth)], 1)[:, :, None]
        of_rays = torch.cat([J * depth[:, None], by_depth[:, None]], 1) - shift * by_depth[:, None]
    return ellipses, Slopes(torch.stack([g1, g2], 1), c - first * first - second * second, of_rays)
