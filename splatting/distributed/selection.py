"""Selections among the values of all ranks, which follow each other in the order of ranks, and sums."""

import torch
from torch import Tensor

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


def summed(mask: Tensor, ranks: Ranks = ALONE) -> int:
    """How many values of all ranks' masks (n,) bool are true."""
    return ranks.before(int(mask.sum()))[1]
