"""Moves of rows between ranks, so that each has as many as the others, in the order of one process."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from scene.gaussians.agreement import match_optimizer
from scene.gaussians.attributes import Rows
from scene.gaussians.row_surgery import Group, map_rows, row_groups
from scene.gaussians.shards import Divided, bound
from scene.gaussians.statistics import NAMES
from splatting.distributed.ranks import Ranks

if TYPE_CHECKING:
    from scene.gaussians.adaptive import AdaptiveGaussians


class Moves:
    """The rows that each rank sends and receives, to be applied to one tensor after the other.

    count: of this rank's rows afterwards.
    """

    def __init__(self, ranks: Ranks, places: Tensor, bounds: Sequence[int]) -> None:
        """Move rows to their places (n,) int64, ascending, among those of all ranks. Every rank must call it.

        bounds: rank r gets the places from bounds[r] to bounds[r + 1].
        """
        self._ranks = ranks
        first, stop = bounds[ranks.rank : ranks.rank + 2]
        self.count = stop - first
        owners = torch.searchsorted(torch.tensor(bounds[1:], device=places.device), places, right=True)
        self._stay = (owners == ranks.rank).nonzero().reshape(-1)
        self._sent = [(owners == rank).nonzero().reshape(-1) for rank in range(ranks.size)]
        self._sent[ranks.rank] = self._stay[:0]
        arrived = torch.cat(ranks.exchange([places[indices] for indices in self._sent]))
        self._here, self._there = places[self._stay] - first, arrived - first
        self._any = ranks.anyone(len(arrived) + sum(map(len, self._sent)) > 0)

    def __call__(self, values: Tensor) -> Tensor:
        """The values of the rows (N, ...) that this rank has afterwards. Every rank must call it."""
        if not self._any:
            return values
        arrived = self._ranks.exchange([values[indices] for indices in self._sent])
        moved = values.new_empty(self.count, *values.shape[1:])
        moved[self._here] = values[self._stay]
        moved[self._there] = torch.cat(arrived)
        return moved


def rows_by_draw(rows: Rows, draws: Tensor, counts: Tensor, ranks: Ranks) -> Rows:
    """Rows for the Gaussians that draws are made for, from the ranks that the draws fell on. Every rank must call it.

    rows (n, ...) of this rank belong to `draws` (n,), ascending; counts (size,): each rank wants those of so many
    draws, which follow each other in the order of ranks.
    """
    if not ranks.several:
        return rows
    moves = Moves(ranks, draws, [0, *counts.cumsum(0).tolist()])
    return {name: moves(values) for name, values in rows.items()}


def changes_rows(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method that every rank must call, after which the rows are divided anew; not within another such method."""

    @wraps(method)
    def changing(gaussians: "AdaptiveGaussians", *args: Any, **named: Any) -> Any:
        with _changing(gaussians):
            return method(gaussians, *args, **named)

    return changing


@contextmanager
def _changing(gaussians: "AdaptiveGaussians") -> Iterator[None]:
    shards = gaussians.shards
    outermost = shards.begin(len(gaussians), gaussians._xyz.device)
    try:
        yield
        if outermost:
            _divide_anew(gaussians, shards)
    finally:
        if outermost:
            shards.end()


def _by_keys(ranks: Ranks, keys: Tensor) -> Moves:
    """Moves of rows into the order of their keys (n,), ascending on every rank, as many rows to each."""
    counts = ranks.numbers(len(keys))[:, 0].tolist()
    # The place of a key: how many keys of all ranks are below it.
    places = sum(torch.searchsorted(part, keys) for part in ranks.gather(keys).split(counts))
    return Moves(ranks, places, [bound(rank, sum(counts), ranks.size) for rank in range(ranks.size + 1)])


def _moving(groups: list[Group], count: int, ranks: Ranks) -> list[Group]:
    """The groups that have a row for every Gaussian, on all ranks."""
    have = [any(group is other for other in row_groups(groups, count)) for group in groups]
    everywhere = ranks.numbers(*map(int, have)).all(dim=0).tolist()
    return [group for group, moves in zip(groups, everywhere, strict=True) if moves]


@torch.no_grad()
def _divide_anew(gaussians: "AdaptiveGaussians", shards: Divided) -> None:
    """Move all that belongs to rows that have changed, one tensor at a time."""
    if not shards.ranks.anyone(shards.changed):
        return
    moves = _by_keys(shards.ranks, shards.keys)
    match_optimizer(gaussians)
    optimised, others, states = gaussians._groups()
    groups = _moving(optimised + others, len(gaussians), shards.ranks)
    gaussians._take(map_rows(groups, states, lambda values, *_: moves(values)))
    for name in (*NAMES, "tmp_radii"):
        values = getattr(gaussians, name, None)
        if values is not None:
            setattr(gaussians, name, moves(values))
    gaussians.shards = shards.of(moves.count)
