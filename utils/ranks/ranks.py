"""The processes (ranks) that train together. By itself, a process is all of them.

torch is imported on first use: not every program needs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

Value = TypeVar("Value")


class Ranks:
    """One process by itself; the base of several (utils/ranks/several.py), whose calls are collective.

    Every rank has to make the same collective calls in the same order. rank: of this process, from 0; size: how many
    there are. Rank 0 writes the files and prints.
    """

    rank = 0
    size = 1
    prompt = False  # whether the others may expect this rank at the next collective call within seconds

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

    def shared(self, value: Value) -> Value:
        """Rank 0's value; of the others it is not read. It can be any object that pickles."""
        return value

    def everyone(self, value: Value) -> list[Value]:
        """All ranks' values, in the order of ranks; any objects that pickle."""
        return [value]

    def largest_(self, numbers: Tensor) -> None:
        """Replace each number of a tensor by the largest that a rank has there, without waiting for a GPU."""

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Send part d (n_d, ...) to rank d, and receive each rank's part for this one, in the order of ranks.

        All parts have one dtype and the same trailing shape, on every rank.
        """
        return list(parts)

    def gather(self, rows: Tensor) -> Tensor:
        """All ranks' rows (n, ...), in the order of ranks."""
        if not self.several:
            return rows
        import torch

        return torch.cat(self.exchange([rows] * self.size))

    def before(self, count: int) -> tuple[int, int]:
        """The sum of all counts of lower ranks, and of all ranks."""
        counts = self.numbers(count)[:, 0]
        return int(counts[: self.rank].sum()), int(counts.sum())

    def anyone(self, fact: bool) -> bool:
        """Whether a fact holds on any rank."""
        return bool(self.numbers(int(fact)).any())

    def busy(self) -> AbstractContextManager[None]:
        """Within it, the others have to wait for this rank as long as it takes, as for a large file."""
        return nullcontext()

    def tell_notes(self) -> None:
        """Print what only other ranks have said so far, with their names (utils/ranks/quiet.py)."""


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
