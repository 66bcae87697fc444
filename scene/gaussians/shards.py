"""Place of a model's rows among those of all ranks, which together are the rows of one process, in its order."""

from collections.abc import Iterable

import torch
from torch import Tensor

from splatting.distributed.ranks import ALONE, Ranks
from splatting.host.device import compute_device

_PART, _RANK = 43, 32  # bits of a key below the number of a part, and below the rank or piece in it


class Shards:
    """One process that has all rows; the base of rows that are divided among ranks.

    ranks: those that share the rows. first: index of this rank's first row among all.
    """

    ranks: Ranks = ALONE
    first = 0

    def total(self, count: int) -> int:
        """The number of all rows, where this rank has `count`."""
        return count

    def of(self, count: int) -> "Shards":
        """The place of `count` rows in another model, or after a change. Every rank must call it."""
        return self

    def own(self, values: Tensor) -> Tensor:
        """This rank's part of the values (N, ...) of all rows."""
        return values

    def items(self, indices: Tensor) -> Tensor:
        """Indices (n,) among all rows, of those of this rank."""
        return indices

    def together(self, found: dict[str, Tensor], names: Iterable[str]) -> dict[str, Tensor]:
        """Indices (n,) among all rows that any rank has found, by some of the names; of those without any nothing."""
        return found

    def begin(self, count: int, device: torch.device) -> bool:
        """Begin a change of `count` rows, unless one goes on. Returns whether to divide the rows anew after it."""
        return False

    def end(self) -> None:
        """End a change of rows."""

    def kept(self, indices: Tensor) -> None:
        """Take note of the rows (n,) that were kept."""

    def appended(self, count: int) -> None:
        """Take note of rows that were appended, of which all ranks' follow each other in the order of ranks."""

    def order(self, *pieces: Tensor) -> None:
        """Change the order of the rows that were appended last: piece by piece, over all ranks.

        pieces: for each row of a piece a number (n,) int64 that orders the rows of this piece on all ranks.
        """


class Divided(Shards):
    """Rows that are divided among several ranks.

    While rows change, each has a key, which orders the rows of all ranks as one process would. keys: (n,) int64,
    ascending, or None. changed: whether this rank's rows have changed.
    """

    def __init__(self, ranks: Ranks, count: int) -> None:
        """Take the place of this rank's rows, `count` of them. Every rank must call it."""
        self.ranks = ranks
        self.first, self._total = ranks.before(count)
        self.keys: Tensor | None = None
        self.changed = False
        self._parts = 0

    def total(self, count: int) -> int:
        return self._total

    def of(self, count: int) -> "Shards":
        return Divided(self.ranks, count)

    def own(self, values: Tensor) -> Tensor:
        first, stop = (bound(rank, len(values), self.ranks.size) for rank in (self.ranks.rank, self.ranks.rank + 1))
        return values[first:stop].clone()  # so that the rest can be freed

    def items(self, indices: Tensor) -> Tensor:
        return indices + self.first

    def together(self, found: dict[str, Tensor], names: Iterable[str]) -> dict[str, Tensor]:
        none = torch.empty(0, dtype=torch.int64, device=compute_device())
        every = {name: self.ranks.gather(self.items(found.get(name, none))) for name in names}
        return {name: rows for name, rows in every.items() if len(rows)}

    def begin(self, count: int, device: torch.device) -> bool:
        if self.keys is not None:
            return False
        self.keys, self.changed, self._parts = self.first + torch.arange(count, device=device), False, 0
        return True

    def end(self) -> None:
        self.keys = None

    def kept(self, indices: Tensor) -> None:
        self.keys, self.changed = self.keys[indices], True

    def appended(self, count: int) -> None:
        self._parts, self.changed = self._parts + 1, True
        first = (self._parts << _PART) + (self.ranks.rank << _RANK)
        self.keys = torch.cat((self.keys, first + torch.arange(count, device=self.keys.device)))

    def order(self, *pieces: Tensor) -> None:
        new = torch.cat([(number << _RANK) + piece for number, piece in enumerate(pieces)])
        self.keys[len(self.keys) - len(new) :] = (self._parts << _PART) + new


WHOLE = Shards()


def bound(rank: int, total: int, size: int) -> int:
    """The first of all rows that a rank has, once they are divided evenly."""
    return rank * total // size
