"""The processes (ranks) that train together. By itself, a process is all of them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

Value = TypeVar("Value")


class Ranks:
    """One process by itself; the base of several (utils/ranks/several.py), whose calls are collective.

    Every rank has to make the same collective calls in the same order. rank: of this process, from 0; size: how many
    there are. Rank 0 writes the files and prints.
    """

    rank = 0
    size = 1

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
        return torch.tensor([values], dtype=torch.int64)

    def shared(self, value: Value) -> Value:
        """Rank 0's value; of the others it is not read. It can be any object that pickles."""
        return value

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Send part d (n_d, ...) to rank d, and receive each rank's part for this one, in the order of ranks.

        All parts have one dtype and the same trailing shape, on every rank.
        """
        return list(parts)

    def gather(self, rows: Tensor) -> Tensor:
        """All ranks' rows (n, ...), in the order of ranks."""
        return torch.cat(self.exchange([rows] * self.size)) if self.several else rows

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
