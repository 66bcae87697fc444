"""The processes (ranks) that train together. By itself, a process is all of them.

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
    """One process by itself; the base of several (distributed/process_group.py), whose calls are collective.

    Every rank has to make the same collective calls in the same order. rank: of this process, from 0; size: how many
    there are. Rank 0 writes the files and prints.
    """

    rank = 0
    size = 1
    flag: Tensor | None = None  # (1,) int64, which each `agree` raises to the largest of all ranks

    @property
    def several(self) -> bool:
        """Whether there are others."""
        return self.size > 1

    @property
    def first(self) -> bool:
        """Whether this is the rank that writes and prints."""
        return self.rank == 0

    def numbers(self, *values: int) -> Tensor:
        """The whole numbers that each rank gives, of which all give as many: (size, len(values)) int64 on the CPU."""
        import torch

        return torch.tensor([values], dtype=torch.int64)

    def shared(self, value: Value, holder: int = 0) -> Value:
        """The value of one rank, the holder; of the others it is not read. It can be any object that pickles."""
        return value

    def handed(
        self, holder: int, values: Tensor | None, shape: Sequence[int], dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """The values of one rank, the holder, which have a shape and dtype that all know; on others, on a device."""
        return values

    def everyone(self, value: Value) -> list[Value]:
        """All ranks' values, in the order of ranks; any objects that pickle."""
        return [value]

    def agree(self, numbers: Tensor, meanwhile: Callable[[], None] = lambda: None) -> list[list[int]]:
        """The whole numbers (n,) int64 of each rank, by rank; the host waits for them.

        meanwhile: called before the host waits, to queue what a GPU does until the host goes on. `flag` and what was
        posted go with them, so that these need no exchange of their own.
        """
        from groundwork.host.read_later import read_later

        found = read_later(numbers)
        meanwhile()
        return [found()]

    def post(self, *news: int) -> None:
        """Leave two whole numbers, 0 or more, that go with the next `agree`."""
        self._news = news

    def heard(self) -> Sequence[int]:
        """The largest of all ranks of each of the numbers that were posted last."""
        return self._news

    def table(self, values: Tensor) -> Tensor:
        """All ranks' values (...), which have one shape and dtype: (size, ...) on their device."""
        return values[None]

    def added(self, values: Tensor) -> Tensor:
        """The sum over all ranks, in no certain order: for whole numbers, or where all but one rank have 0.

        It may take the place of the values.
        """
        return values

    def send(self, rows: Tensor, sizes: Sequence[int], counts: Sequence[int] | None = None) -> tuple[Tensor, list[int]]:
        """Send the first sizes[0] of the rows (n, ...) to rank 0, the next to rank 1, and so on.

        counts: how many rows each rank sends here, if this is known; else the ranks tell each other, which a GPU waits
        for. Rows have one dtype, not of 16 bits, and the same trailing shape on every rank. Returns the rows for this
        rank, in the order of ranks, and how many each has sent.
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

    def gather(self, rows: Tensor, counts: Sequence[int] | None = None) -> Tensor:
        """All ranks' rows (n, ...), in the order of ranks. counts: how many each has, if this is known (`send`)."""
        if not self.several:
            return rows
        import torch

        return self.send(torch.cat([rows] * self.size), [len(rows)] * self.size, counts)[0]

    def before(self, count: int) -> tuple[int, int]:
        """The sum of all counts of lower ranks, and of all ranks."""
        counts = self.numbers(count)[:, 0]
        return int(counts[: self.rank].sum()), int(counts.sum())

    def anyone(self, fact: bool) -> bool:
        """Whether a fact holds on any rank."""
        return bool(self.numbers(int(fact)).any())


ALONE = Ranks()
_current = ALONE


def ranks() -> Ranks:
    """The ranks of this training."""
    return _current


@contextmanager
def using(several: Ranks) -> Iterator[Ranks]:
    """Within it, `ranks` gives these."""
    global _current
    before, _current = _current, several
    try:
        yield several
    finally:
        _current = before


def refuse_differences(facts: Sequence[Mapping[str, str]], remedy: str, shown: bool = True) -> None:
    """UserError that names the facts by which ranks differ from rank 0, and these ranks.

    facts: by rank, the values by name. shown: with the values of one of these ranks.
    """
    first = facts[0]
    for rank, others in enumerate(facts):
        names = [name for name in {**first, **others} if first.get(name) != others.get(name)]
        if names:
            raise UserError(
                f"rank {rank} differs from rank 0 in {some(_described(names, first, others, shown))}; {remedy}"
            )


def _described(names: Sequence[str], first: Mapping[str, str], other: Mapping[str, str], shown: bool) -> list[str]:
    if not shown:
        return list(names)
    return [f"{name} ({_short(other.get(name))}, not {_short(first.get(name))})" for name in names]


def _short(value: str | None) -> str:
    return "nothing" if value is None else value if len(value) <= _SHORT else value[:_SHORT] + "..."
