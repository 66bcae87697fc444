"""Share of the spherical-harmonics bands in the colours of a model."""

import math

import torch
from torch import Tensor

from groundwork.ranks.rows import PIECE, WHOLE, Shards

SH_INTERVAL = 1000  # iterations between raises of the active SH degree; shorter trainings raise it sooner


def cut_bounds(f_rest: Tensor, shards: Shards = WHOLE, keep: Tensor | None = None) -> list[float]:
    """By degree d = 0..D: the most a colour can change, in any direction, when all bands above d are cut.

    f_rest: (N, (D+1)^2 - 1, 3) of this process's Gaussians; the bounds are of all's. keep: (N,) bool, those that count,
    None: all. With c_l the coefficients of band l, the bound is the sum over l > d of |c_l| sqrt((2l+1) / 4 pi), the
    largest of all Gaussians and channels. It follows from Cauchy-Schwarz and from Unsoeld's theorem: the basis
    functions of a band have the same length in every direction.
    The bound holds for images, too: a pixel's weights sum to at most 1, and clamping never increases a difference.
    """
    degree = math.isqrt(f_rest.shape[1] + 1) - 1
    if not shards.ranks.offset_and_total(len(f_rest) if keep is None else int(keep.sum()))[1]:
        return [0.0] * (degree + 1)
    pieces = [f_rest.new_zeros(0, degree, dtype=torch.float64)]
    for start in range(0, len(f_rest), PIECE):
        part = f_rest[start : start + PIECE]
        pieces.append(_compute_bounds(part if keep is None else part[keep[start : start + PIECE]], degree))
    return [*(float(shards.largest(most)) for most in torch.cat(pieces).unbind(1)), 0.0]


def _compute_bounds(f_rest: Tensor, degree: int) -> Tensor:
    """The bounds (N, degree) of each Gaussian, by degree from 0 on."""
    total = f_rest.new_zeros(len(f_rest), 3, dtype=torch.float64)
    bounds = []
    for band in range(degree, 0, -1):
        coefficients = f_rest[:, band**2 - 1 : (band + 1) ** 2 - 1]
        length = torch.linalg.vector_norm(coefficients, dim=1, dtype=torch.float64)
        total += length * math.sqrt((2 * band + 1) / (4 * math.pi))
        bounds.append(total.amax(dim=1))
    return torch.stack(bounds[::-1], 1) if bounds else total[:, :0]


def needed_degree(bounds: list[float], tolerance: float) -> int:
    """The lowest degree whose bound in `cut_bounds` is at most `tolerance`."""
    return next(degree for degree, bound in enumerate(bounds) if bound <= tolerance)
