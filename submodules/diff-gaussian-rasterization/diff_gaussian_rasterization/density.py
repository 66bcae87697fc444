"""Density control's computations besides its decisions. Nothing here is differentiable."""

from torch import Tensor

from diff_gaussian_rasterization.backend import OPERATORS

_split_positions = OPERATORS.split_positions


def split_positions(
    means: Tensor,
    log_scales: Tensor,
    rotations: Tensor,
    items: Tensor,
    *,
    seed: int,
    stream: int,
    iteration: int,
    draw: int,
) -> Tensor:
    """Centres (n, 3) of one child for each of n split Gaussians: normal about its parent, with the parent's shape.

    means (n, 3), log_scales (n, 3) and rotations (n, 4) wxyz of any length are the parents', float32. items: (n,)
    int64, their indices in the model. The random numbers are a function of seed (its lower 64 bits), stream, iteration,
    item and draw, each of the last four below 2^32. Every device and number of threads gives the same bits.
    """
    signed = (seed + 2**63) % 2**64 - 2**63
    return _split_positions(means, log_scales, rotations, items, signed, stream, iteration, draw)
