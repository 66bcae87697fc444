"""The processes (ranks) that train together. A process by itself is the only rank.

torch is imported on first use: not every program needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from groundwork.host.errors import UserError
from groundwork.host.listing import some

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Value = TypeVar("Value")
_SHORT = 60  # letters of a value that a message shows


class Ranks:
    """One process by itself; the base class of several ranks (groundwork/ranks/process_group.py).

    Calls are collective: every rank has to make the same calls in the same order. Rank 0 writes the files and prints.

    rank: number of this process, from 0.
    size: number of ranks.
    flag: (1,) int64, which each `all_gather_ints` overwrites with the largest of all ranks, if that is larger; the
        owner of the tensor reads there what another rank has set. None on all ranks: no flag.
    """

    rank = 0
    size = 1
    flag: Tensor | None = None

    @property
    def several(self) -> bool:
        """True if there are other ranks."""
        return self.size > 1

    @property
    def first(self) -> bool:
        """True for the rank that writes and prints."""
        return self.rank == 0

    def all_gather_host_ints(self, *values: int) -> Tensor:
        """Gather integers of the host, as many from each rank: (size, len(values)) int64 on the CPU."""
        import torch

        return torch.tensor([values], dtype=torch.int64)

    def broadcast_object(self, value: Value, holder: int = 0) -> Value:
        """Return the holder's value on every rank; the other ranks' value is ignored. Any object that pickles."""
        return value

    def broadcast_from(
        self, holder: int, values: Tensor | None, shape: Sequence[int], dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """Broadcast the holder's tensor, whose shape and dtype all ranks know; the others receive it on `device`."""
        return values

    def all_gather_objects(self, value: Value) -> list[Value]:
        """Return all ranks' values in the order of ranks; any objects that pickle."""
        return [value]

    def all_gather_ints(self, numbers: Tensor, meanwhile: Callable[[], None] = lambda: None) -> list[list[int]]:
        """Gather integers (n,) int64 of all ranks, in the order of ranks; the host waits for them.

        `flag` and the numbers of `piggyback` are exchanged in the same call.

        meanwhile: called before the host waits, to queue work for a GPU.
        """
        from groundwork.host.read_later import read_later

        found = read_later(numbers)
        meanwhile()
        return [found()]

    def piggyback(self, *news: int) -> None:
        """Leave two integers, 0 or more, that the next `all_gather_ints` sends along to save a message."""
        self._piggybacked = news

    def latest(self) -> Sequence[int]:
        """Return the maximum over ranks of each number of the last `piggyback`; exchange them first if need be."""
        return self._piggybacked

    def all_gather(self, values: Tensor) -> Tensor:
        """Gather all ranks' values (...), of one shape and dtype: (size, ...) on their device."""
        return values[None]

    def all_reduce_sum(self, values: Tensor) -> Tensor:
        """Sum over all ranks, in no certain order: for integers, or where all ranks but one have 0.

        The sum may overwrite `values`.
        """
        return values

    def send(self, rows: Tensor, sizes: Sequence[int], counts: Sequence[int] | None = None) -> tuple[Tensor, list[int]]:
        """Send the first sizes[0] of the rows (n, ...) to rank 0, the next sizes[1] to rank 1, and so on.

        rows: of one dtype, not of 16 bits, and one trailing shape on every rank.
        counts: number of rows that each rank sends here, if known; else ranks exchange it, for which a GPU waits.

        Returns the rows received, in the order of ranks, and the number of rows from each rank.
        """
        return rows, list(sizes)

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Send part d (n_d, ...) to rank d, and receive each rank's part for this one, in the order of ranks.

        All parts have one dtype and the same trailing shape, on every rank.
        """
        if not self.several:
            return list(parts)
        import torch

        rows, counts = self.send(torch.cat(list(parts)), list(map(len, parts)))
        return list(rows.split(counts))

    def all_gather_rows(self, rows: Tensor, counts: Sequence[int] | None = None) -> Tensor:
        """Gather all ranks' rows (n, ...), in the order of ranks. counts: rows of each rank, if known (see `send`)."""
        if not self.several:
            return rows
        import torch

        return self.send(torch.cat([rows] * self.size), [len(rows)] * self.size, counts)[0]

    def offset_and_total(self, count: int) -> tuple[int, int]:
        """Return the sum of the lower ranks' counts, and the sum over all ranks."""
        counts = self.all_gather_host_ints(count)[:, 0]
        return int(counts[: self.rank].sum()), int(counts.sum())

    def any_rank(self, fact: bool) -> bool:
        """Tell whether `fact` is true on any rank."""
        return bool(self.all_gather_host_ints(int(fact)).any())


ALONE = Ranks()
_current = ALONE


def ranks() -> Ranks:
    """The ranks of this training."""
    return _current


@contextmanager
def using(several: Ranks) -> Iterator[Ranks]:
    """Let `ranks` return `several` inside the block."""
    global _current
    before, _current = _current, several
    try:
        yield several
    finally:
        _current = before


def refuse_differences(facts: Sequence[Mapping[str, str]], remedy: str, shown: bool = True) -> None:
    """Raise UserError if ranks differ from rank 0 in a fact; the message names facts and ranks.

    facts: values by name, for each rank.
    shown: whether the message has rank 0's values, and those of one rank that differs.
    """
    first = facts[0]
    for rank, others in enumerate(facts):
        names = [name for name in {**first, **others} if first.get(name) != others.get(name)]
        if names:
            raise UserError(
                f"rank {rank} differs from rank 0 in {some(_tell_apart(names, first, others, shown))}; {remedy}"
            )


def _tell_apart(names: Sequence[str], first: Mapping[str, str], other: Mapping[str, str], shown: bool) -> list[str]:
    if not shown:
        return list(names)
    return [f"{name} ({_shorten(other.get(name))}, not {_shorten(first.get(name))})" for name in names]


def _shorten(value: str | None) -> str:
    return "nothing" if value is None else value if len(value) <= _SHORT else value[:_SHORT] + "..."
