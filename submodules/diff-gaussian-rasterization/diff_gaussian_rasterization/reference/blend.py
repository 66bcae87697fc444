"""Blending front to back (Kerbl et al. 2023, eq. 3), with the limits of that paper's appendix C."""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.reference.camera import Points
from diff_gaussian_rasterization.reference.ray import Slopes
from diff_gaussian_rasterization.reference.shape import Ellipses

LEAST_ALPHA = 1 / 255  # a pixel blends no smaller alpha
LARGEST_ALPHA = 0.99
LEAST_TRANSMITTANCE = 1e-4  # a splat that would leave less ends the pixel and is not blended itself


class Splats(NamedTuple):
    """The M Gaussians in front of the camera, nearest first; equal depths keep the order of their index."""

    pixel: Tensor  # (M, 2) px
    r11: Tensor  # (M,) of the ellipse, as are the next two
    r12: Tensor
    r22: Tensor
    opacity: Tensor  # (M,)
    color: Tensor  # (M, 3)
    depth: Tensor  # (M,) world units
    is_tie: Tensor  # (M,) bool: about as deep as the splat before, so that rounding may swap them
    slopes: Slopes | None  # None for EWA


class Planes(NamedTuple):
    """Some rows of the image."""

    color: Tensor  # (3, rows, W)
    inverse_depth: Tensor  # (rows, W)
    transmittance: Tensor  # (rows, W)
    near_cut: Tensor  # (rows, W) bool


def nearest_first(
    points: Points, ellipses: Ellipses, slopes: Slopes | None, opacity: Tensor, colors: Tensor, cut: float
) -> Splats:
    """Drops the Gaussians that are not in front and sorts the others by depth."""
    key = torch.where(points.in_front, points.depth, torch.inf)
    order = torch.argsort(key, stable=True)[: int(points.in_front.sum())]
    depth = points.depth[order]
    is_tie = torch.zeros(len(order), dtype=torch.bool)
    is_tie[1:] = depth.diff() < 0.01 * cut * depth[1:]
    factor = (entry[order] for entry in ellipses[:3])
    slopes = slopes and Slopes(*(None if values is None else values[order] for values in slopes))
    return Splats(points.pixel[order], *factor, opacity[order], colors[order], depth, is_tie, slopes)


def blend_rows(splats: Splats, background: Tensor, rays: Tensor | None, rows: range, width: int, cut: float) -> Planes:
    """Blend image rows: C = sum of c_i alpha_i T_i, where T_i is the product of 1 - alpha_j over nearer splats j.

    background: (3,).
    rays: (H, W, 3), directions of a lens's pixels; None for EWA and for pinholes.
    rows: rows of the image to blend.
    cut: relative distance from LEAST_ALPHA or LEAST_TRANSMITTANCE, within which rounding may decide what a pixel
        blends. Such pixels are true in `near_cut` of the result, as are those with a depth tie.
    """
    uncapped = alphas(splats, rows, width) if splats.slopes is None else ray_alphas(splats, rays, rows, width)
    reached = uncapped >= LEAST_ALPHA
    alpha = uncapped + (torch.clamp(uncapped, max=LARGEST_ALPHA) - uncapped).detach()  # the gradient passes the cap
    alpha = torch.where(reached, alpha, 0.0)
    left = torch.cumprod(1 - alpha, 0)  # transmittance behind each splat, if all were blended
    may_flip = _is_near_limit(uncapped, LEAST_ALPHA, cut) | _is_near_limit(left, LEAST_TRANSMITTANCE, cut)
    may_flip = may_flip | (splats.is_tie[:, None, None] & reached)

    alpha = torch.where(left >= LEAST_TRANSMITTANCE, alpha, 0.0)
    behind = torch.cumprod(1 - alpha, 0)
    transmittance = behind[-1] if len(behind) else torch.ones(len(rows), width, dtype=torch.float64)
    T = torch.cat([torch.ones_like(behind[:1]), behind[:-1]])
    weight = alpha * T
    color = torch.einsum("nhw,nc->chw", weight, splats.color) + transmittance * background[:, None, None]
    inverse_depth = (weight / splats.depth[:, None, None]).sum(0)
    return Planes(color, inverse_depth, transmittance, may_flip.any(0))


def alphas(splats: Splats, rows: range, width: int) -> Tensor:
    """Opacity times the Gaussian of Kerbl et al. 2023, eq. 4, on the image: (M, rows, W)."""
    u, v = _whiten(splats, *_offsets_to_pixels(splats, rows, width))
    return splats.opacity[:, None, None] * torch.exp(-0.5 * (u * u + v * v))


def ray_alphas(splats: Splats, rays: Tensor | None, rows: range, width: int) -> Tensor:
    """Opacity times exp(-D^2 / 2) of `reference.ray`: (M, rows, W). rays (H, W, 3): of a lens."""
    g, e, of_rays = splats.slopes
    if of_rays is None:
        (dx, dy), depth = _offsets_to_pixels(splats, rows, width), 1.0
    else:
        dx, dy, depth = torch.einsum("nik,hwk->inhw", of_rays, rays[rows.start : rows.stop])
    s = depth + g[:, 0, None, None] * dx + g[:, 1, None, None] * dy
    u, v = _whiten(splats, dx, dy)
    q, hit = u * u + v * v, s > 0
    square = q / (torch.where(hit, s, 1.0) ** 2 + e[:, None, None] * q)
    return torch.where(hit, splats.opacity[:, None, None] * torch.exp(-0.5 * square), 0.0)


def _offsets_to_pixels(splats: Splats, rows: range, width: int) -> tuple[Tensor, Tensor]:
    """From a splat's mean to a pixel, px: (M, 1, W) and (M, rows, 1)."""
    x = torch.arange(width, dtype=torch.float64)
    y = torch.arange(rows.start, rows.stop, dtype=torch.float64)
    return x[None, None, :] - splats.pixel[:, 0, None, None], y[None, :, None] - splats.pixel[:, 1, None, None]


def _whiten(splats: Splats, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """(u, v) with covariance = R^T R and R^T (u, v) = (dx, dy): -(u^2 + v^2) / 2 cannot become positive."""
    r11, r12, r22 = (t[:, None, None] for t in (splats.r11, splats.r12, splats.r22))
    u = dx / r11
    return u, (dy - r12 * u) / r22


def _is_near_limit(values: Tensor, limit: float, cut: float) -> Tensor:
    """Tell which values lie within a relative distance `cut` of a limit, in the shape of the values."""
    return (values * (1 / limit) - 1).abs() < cut
