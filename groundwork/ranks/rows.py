"""The division of a model's rows among ranks, and their redistribution after a change.

A block is BLOCK consecutive rows. Each rank has whole blocks, except the last one of all.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import wraps
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from groundwork.deterministic.counter_rng import Stream, random_bits
from groundwork.deterministic.portable_math import log
from groundwork.host.machine import compute_device
from groundwork.ranks.ranks import ALONE, Ranks

PIECE = 1 << 16  # rows that are sent at a time
BLOCK = 128  # rows that one rank has together, as they sleep together (scene/sleeping.py)
_PART, _RANK = 43, 32  # bits of a key below the number of a part, and below the rank or piece in it


class Shards:
    """The rows of a model that one process has alone; the base class of divided rows.

    ranks: the ranks that share the rows.
    first: index of this rank's first row among all rows.
    """

    ranks: Ranks = ALONE
    first = 0

    def total(self, count: int) -> int:
        """Number of rows on all ranks. count: this rank's."""
        return count

    def resized(self, count: int) -> "Shards":
        """Return the shards of another model, or after a change, with `count` rows here. Every rank must call it."""
        return self

    @property
    def blocks(self) -> Sequence[int] | None:
        """Number of blocks of rows of each rank; None for one process."""
        return None

    def own_rows(self, values: Tensor) -> Tensor:
        """This rank's part of the values (N, ...) of all rows."""
        return values

    def gather_whole(self, values: Tensor) -> Tensor:
        """Gather all rows (N, ...) on the CPU of the rank that writes files. Every rank must call it."""
        return values

    def pieces(self, count: int, part: Callable[[slice], Tensor]) -> Iterator[Tensor]:
        """Yield all rows in order, piece by piece, on the rank that writes files; other ranks must iterate, too.

        count: number of this rank's rows.
        part: returns a slice of this rank's rows (n, ...).
        """
        ranks = self.ranks
        for holder, rows in enumerate(ranks.all_gather_host_ints(count)[:, 0].tolist()):
            for start in range(0, rows, PIECE):
                piece = part(slice(start, start + PIECE) if holder == ranks.rank else slice(0, 0))
                received = ranks.exchange([piece, *[piece[:0]] * (ranks.size - 1)])
                if ranks.first:
                    yield received[holder]

    def global_indices(self, indices: Tensor) -> Tensor:
        """Convert indices (n,) of this rank's rows to indices among all rows."""
        return indices

    def count_marked(self, mask: Tensor) -> int:
        """Count the true values of all ranks' masks (N,) bool."""
        return self.ranks.offset_and_total(int(mask.sum()))[1]

    def marked_indices(self, mask: Tensor) -> Tensor:
        """Return the indices (n,) among all rows that the ranks' masks (N,) bool mark."""
        return self.ranks.all_gather_rows(self.global_indices(mask.nonzero().reshape(-1)))

    def choose(self, weights: Tensor, count: int, *, seed: int, stream: Stream, iteration: int) -> Tensor:
        """Draw `count` of all rows without replacement, by weight; return this rank's, (n,) int64 ascending.

        weights: (N,) float64. A row whose weight is not above 0, or not finite, is never drawn, so there may be fewer.
        Algorithm A-Res (Efraimidis and Spirakis 2006): with a uniform number u for each row, the largest
        log(u) / weight are drawn; ties go to the lower row. Same weights, same rows, on every device and number of
        threads or ranks.
        """
        rows = ((weights > 0) & weights.isfinite()).nonzero().reshape(-1)
        if self.ranks.offset_and_total(len(rows))[1] <= count:
            return rows
        waits = -log(_make_uniform(random_bits(seed, stream, iteration, rows + self.first))) / weights[rows]
        return rows[self.lowest(waits, count)].sort().values

    def lowest(self, values: Tensor, count: int, *, highest: bool = False) -> Tensor:
        """Return indices, in no order, of this rank's values (n,) among the `count` lowest of all; the first of equals.

        highest: the highest instead, again the first of equals. No rank sends more than `count` values.
        """
        ranks, count = self.ranks, max(count, 0)
        mine = torch.argsort(values, descending=highest, stable=True)[:count]
        if not ranks.several:
            return mine
        every = ranks.all_gather_rows(values[mine])  # of equal values of a rank the first comes first, as ranks do
        chosen = torch.argsort(every, descending=highest, stable=True)[:count] - ranks.offset_and_total(len(mine))[0]
        return mine[chosen[(chosen >= 0) & (chosen < len(mine))]]

    def largest(self, values: Tensor) -> Tensor:
        """The maximum, a scalar, of all ranks' values (n,); at least one rank must have a value."""
        if self.ranks.several:
            values = self.ranks.all_gather_rows(values.amax(0, keepdim=True) if len(values) else values)
        return values.max()

    def send_draws(self, rows: dict[str, Tensor], draws: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """Send the rows of drawn Gaussians to the ranks for which they were drawn. Every rank must call it.

        rows: this rank's rows (n, ...) that were drawn.
        draws: (n,), ascending, the number of the draw of each row.
        counts: (size,), number of draws for each rank, in the order of ranks.
        """
        return rows

    def changing(self, gaussians: Any) -> AbstractContextManager[None]:
        """Return a context within which rows may change; its end divides them again. A nested call does nothing."""
        return nullcontext()

    def match_steps(self, optimizer: torch.optim.Optimizer | None) -> None:
        """Copy the last rank's step counters, and the order of states, to every rank. Every rank must call it.

        A rank without Gaussians takes no steps; the last rank has Gaussians if any has.
        """

    def sort(self, gaussians: Any, codes: Tensor) -> None:
        """Sort all rows by their codes (N,) int64, stably. Every rank must call it."""
        gaussians.table.permute(codes.argsort(stable=True))

    def note_kept(self, indices: Tensor) -> None:
        """Note that only these rows (n,) were kept."""

    def note_appended(self, count: int) -> None:
        """Note that `count` rows were appended; all ranks' new rows follow each other in the order of ranks."""

    def order_appended(self, *pieces: Tensor) -> None:
        """Order the rows that were appended last piece by piece, over all ranks.

        pieces: for each piece numbers (n,) int64, one a row, by which the rows of the piece are ordered over all ranks.
        """


class Divided(Shards):
    """Rows that are divided among several ranks.

    While rows change, keys order the rows of all ranks as one process would.

    keys: (n,) int64, ascending, or None.
    changed: whether this rank's rows have changed.
    """

    def __init__(self, ranks: Ranks, count: int) -> None:
        """Find the place of this rank's `count` rows among all. Every rank must call it."""
        self.ranks = ranks
        self.first, self._total = ranks.offset_and_total(count)
        self.keys: Tensor | None = None
        self.changed = False
        self._parts = 0

    def total(self, count: int) -> int:
        return self._total

    def resized(self, count: int) -> "Shards":
        return Divided(self.ranks, count)

    @property
    def blocks(self) -> Sequence[int] | None:
        ends = [-(-bound(rank, self._total, self.ranks.size) // BLOCK) for rank in range(self.ranks.size + 1)]
        return [end - first for first, end in pairwise(ends)]

    def own_rows(self, values: Tensor) -> Tensor:
        return own_rows(values, self.ranks)

    def gather_whole(self, values: Tensor) -> Tensor:
        """Gather the rows of all processes in the first one, on the CPU; others get no rows."""
        total = self.ranks.offset_and_total(len(values))[1]
        every = torch.empty(total if self.ranks.first else 0, *values.shape[1:], dtype=values.dtype)
        filled = 0
        for piece in self.pieces(len(values), lambda rows: values.detach()[rows].to(compute_device())):
            every[filled : filled + len(piece)] = piece
            filled += len(piece)
        return every

    def global_indices(self, indices: Tensor) -> Tensor:
        return indices + self.first

    def send_draws(self, rows: dict[str, Tensor], draws: Tensor, counts: Tensor) -> dict[str, Tensor]:
        moves = Redistribution(self.ranks, draws, [0, *counts.cumsum(0).tolist()])
        return {name: moves(values) for name, values in rows.items()}

    @contextmanager
    def changing(self, gaussians: Any) -> Iterator[None]:
        """Let rows be added or removed while the context lasts, then divide all rows among the processes again."""
        if self.keys is not None:
            yield
            return
        device = gaussians.get_xyz.device
        self.keys, self.changed, self._parts = self.first + torch.arange(len(gaussians), device=device), False, 0
        try:
            yield
            self._divide_again(gaussians)
        finally:
            self.keys = None

    def _divide_again(self, gaussians: Any) -> None:
        if self.ranks.any_rank(self.changed):
            self._move(gaussians, self.keys)

    def sort(self, gaussians: Any, codes: Tensor) -> None:
        order = codes.argsort(stable=True)
        gaussians.table.permute(order)
        self._move(gaussians, codes[order])

    @torch.no_grad()
    def _move(self, gaussians: Any, keys: Tensor) -> None:
        """Move rows, with optimiser state and statistics, to where their keys (n,), ascending, put them."""
        ranks = self.ranks
        counts = ranks.all_gather_host_ints(len(keys))[:, 0].tolist()
        # The place of a key: how many keys of all ranks come before it, and of equal ones those of lower ranks.
        places = torch.arange(len(keys), device=keys.device)
        for rank, part in enumerate(ranks.all_gather_rows(keys).split(counts)):
            if rank != ranks.rank:
                places = places + torch.searchsorted(part, keys, right=rank < ranks.rank)
        bounds = [bound(rank, sum(counts), ranks.size) for rank in range(ranks.size + 1)]
        moves = Redistribution(ranks, places, bounds)
        self.match_steps(gaussians.optimizer)
        table = gaussians.table
        groups, own = [*table.optimised, *table.others], table.row_groups()
        here = [any(group is other for other in own) for group in groups]
        everywhere = ranks.all_gather_host_ints(*map(int, here)).all(dim=0).tolist()
        table.change(moves, [group for group, moving in zip(groups, everywhere, strict=True) if moving])
        gaussians.shards = self.resized(moves.count)

    def match_steps(self, optimizer: torch.optim.Optimizer | None) -> None:
        """Give the optimiser of each process the order of states and the step counts of the last process."""
        if optimizer is None:
            return
        params, states = [group["params"][0] for group in optimizer.param_groups], optimizer.state
        make = getattr(optimizer, "state_of", None)
        order = {param: number for number, param in enumerate(states)}
        mine = [number for param in params for number in (order.get(param, -1), _count_steps(states.get(param, {})))]
        last = self.ranks.all_gather_host_ints(*mine)[-1].reshape(-1, 2).tolist()
        for place, steps, index in sorted((*numbers, index) for index, numbers in enumerate(last)):
            param = params[index]
            if place < 0 or (param not in states and make is None):
                continue
            state = states.pop(param) if param in states else make(param)
            states.pop(param, None)
            states[param] = state
            if torch.is_tensor(state.get("step")):
                state["step"].fill_(steps)

    def note_kept(self, indices: Tensor) -> None:
        self.keys, self.changed = self.keys[indices], True

    def note_appended(self, count: int) -> None:
        self._parts, self.changed = self._parts + 1, True
        first = (self._parts << _PART) + (self.ranks.rank << _RANK)
        self.keys = torch.cat((self.keys, first + torch.arange(count, device=self.keys.device)))

    def order_appended(self, *pieces: Tensor) -> None:
        new = torch.cat([(number << _RANK) + piece for number, piece in enumerate(pieces)])
        self.keys[len(self.keys) - len(new) :] = (self._parts << _PART) + new


WHOLE = Shards()


def bound(rank: int, total: int, size: int) -> int:
    """Return the index of a rank's first row where whole blocks of rows are divided evenly; of rank `size`, the total.

    total: number of all rows.
    size: number of ranks.
    """
    return min(rank * -(-total // BLOCK) // size * BLOCK, total)


def own_rows(values: Tensor, ranks: Ranks) -> Tensor:
    """Copy this rank's part of the values (N, ...) of all rows, so that the rest can be freed."""
    first, stop = (bound(rank, len(values), ranks.size) for rank in (ranks.rank, ranks.rank + 1))
    return values[first:stop].clone()


def changes_rows(method: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a method or function of a model that changes rows: they are divided again. Every rank must call it."""

    @wraps(method)
    def changing(gaussians: Any, *args: Any, **named: Any) -> Any:
        with gaussians.shards.changing(gaussians):
            return method(gaussians, *args, **named)

    return changing


class Redistribution:
    """A movement of rows between ranks, to be applied to one tensor after the other.

    count: number of this rank's rows afterwards.
    """

    def __init__(self, ranks: Ranks, places: Tensor, bounds: Sequence[int]) -> None:
        """Plan the movement. Every rank must call it.

        places: (n,) int64, ascending, the new indices of this rank's rows among all rows.
        bounds: rank r gets the indices from bounds[r] to bounds[r + 1].
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
        self._any = ranks.any_rank(len(arrived) + sum(map(len, self._sent)) > 0)

    def __call__(self, values: Tensor) -> Tensor:
        """Move a tensor's rows (N, ...); return this rank's new ones. Every rank must call it."""
        if not self._any:
            return values
        arrived = self._ranks.exchange([values[indices] for indices in self._sent])
        moved = values.new_empty(self.count, *values.shape[1:])
        moved[self._here] = values[self._stay]
        moved[self._there] = torch.cat(arrived)
        return moved


def _make_uniform(bits: Tensor) -> Tensor:
    """Numbers in (0, 1), odd multiples of 2^-53, from rows of 32-bit numbers (n, 4): (n,) float64."""
    whole = (bits[:, 0] << 20) | (bits[:, 1] >> 12)
    return (2 * whole + 1).to(torch.float64) * 2.0**-53


def _count_steps(state: dict[str, Any]) -> int:
    return int(state.get("step", 0))
