"""Weighted sampling without replacement and without state (Efraimidis and Spirakis 2006)."""

import torch
from torch import Tensor

from splatting.deterministic.counter_rng import Stream, random_bits
from splatting.deterministic.portable_math import log
from splatting.distributed.ranks import ALONE, Ranks
from splatting.distributed.selection import lowest


def weighted_choice(
    weights: Tensor, count: int, *, seed: int, stream: Stream, iteration: int, first: int = 0, ranks: Ranks = ALONE
) -> Tensor:
    """Indices of `count` items, drawn one after another by the weights of those left: ascending, (n,) int64.

    weights: (N,) float64. An item whose weight is not above 0, or not finite, is never drawn, so there may be fewer.
    Algorithm A-Res: with a uniform number u for each item, the largest log(u) / weight are drawn; ties go to the lower
    index. Same weights, same items, on every device and number of threads. Items of several ranks follow each other:
    `first` is the index of this rank's first one among all, and its own of those drawn are returned.
    """
    items = ((weights > 0) & weights.isfinite()).nonzero().reshape(-1)
    if ranks.before(len(items))[1] <= count:
        return items
    waits = -log(_uniform(random_bits(seed, stream, iteration, items + first))) / weights[items]
    return items[lowest(waits, count, ranks)].sort().values


def _uniform(bits: Tensor) -> Tensor:
    """Numbers in (0, 1), odd multiples of 2^-53, from rows of 32-bit numbers (n, 4): (n,) float64."""
    whole = (bits[:, 0] << 20) | (bits[:, 1] >> 12)
    return (2 * whole + 1).to(torch.float64) * 2.0**-53
