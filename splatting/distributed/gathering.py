"""Rows of all ranks on the one that writes files, in the order of one process."""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from splatting.distributed.ranks import Ranks

PIECE = 1 << 16  # rows that are sent at a time


def in_order(ranks: Ranks, count: int, part: Callable[[slice], Tensor]) -> Iterator[Tensor]:
    """Pieces of all ranks' rows, on the rank that writes; other ranks get none, yet must go through all.

    count: of this rank's rows; part: gives some of them (n, ...).
    """
    for holder, rows in enumerate(ranks.numbers(count)[:, 0].tolist()):
        for start in range(0, rows, PIECE):
            piece = part(slice(start, start + PIECE) if holder == ranks.rank else slice(0, 0))
            received = ranks.exchange([piece, *[piece[:0]] * (ranks.size - 1)])
            if ranks.first:
                yield received[holder]


def whole(values: Tensor, ranks: Ranks) -> Tensor:
    """All ranks' rows (N, ...), on the CPU of the rank that writes; none elsewhere. Every rank must call it."""
    total = ranks.before(len(values))[1]
    every = torch.empty(total if ranks.first else 0, *values.shape[1:], dtype=values.dtype)
    filled = 0
    for piece in in_order(ranks, len(values), values.detach().__getitem__):
        every[filled : filled + len(piece)] = piece
        filled += len(piece)
    return every
