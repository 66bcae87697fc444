"""Selections among the values of all ranks, which follow each other in the order of ranks."""

import torch
from torch import Tensor

from splatting.deterministic.counter_rng import Stream, random_bits
from splatting.deterministic.portable_math import log
from splatting.distributed.ranks import ALONE, Ranks


def lowest(values: Tensor, count: int, ranks: Ranks = ALONE, *, highest: bool = False) -> Tensor:
    """Indices, in no order, of this rank's values (n,) that are among the `count` lowest of all; ties by place.

    highest: among the highest, ties by place as well. No rank sends more than `count` values.
    """
    count = max(count, 0)
    mine = torch.argsort(values, descending=highest, stable=True)[:count]
    if not ranks.several:
        return mine
    every = ranks.gather(values[mine])  # of equal values of a rank the first comes first, as ranks do
    chosen = torch.argsort(every, descending=highest, stable=True)[:count] - ranks.before(len(mine))[0]
    return mine[chosen[(chosen >= 0) & (chosen < len(mine))]]


def largest(values: Tensor, ranks: Ranks = ALONE) -> Tensor:
    """The largest value, a scalar, of all ranks' values (n,), of which some rank must have one."""
    if ranks.several:
        values = ranks.gather(values.amax(0, keepdim=True) if len(values) else values)
    return values.max()


def weighted_choice(
    weights: Tensor, count: int, *, seed: int, stream: Stream, iteration: int, first: int = 0, ranks: Ranks = ALONE
) -> Tensor:
    """Indices of `count` items, drawn one after another by the weights of those left: ascending, (n,) int64.

    weights: (N,) float64. An item whose weight is not above 0, or not finite, is never drawn, so there may be fewer.
    Algorithm A-Res (Efraimidis and Spirakis 2006): with a uniform number u for each item, the largest log(u) / weight
    are drawn; ties go to the lower index. Same weights, same items, on every device and number of threads. Items of
    several ranks follow each other: `first` is the index of this rank's first one among all, and its own of those drawn
    are returned.
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
