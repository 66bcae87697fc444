"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back.

What a GPU computes is read by the host, which then waits, as rarely as can be: once to learn how many records all ranks
send, and once how many gradient rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
import torch.nn.functional as F
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from splatting.distributed.ranks import Ranks
from splatting.distributed.rendering.bands import Bands
from splatting.host.read_later import read_later

_ROOM = 1.25  # records for each Gaussian, of which views see a part and few reach two bands


@dataclass(slots=True)
class Sent:
    """Which of a rank's own Gaussians each rank got, as a record, and how many records this one got from each."""

    gaussians: Tensor  # (n,), ascending for each rank, rank after rank
    sizes: list[int]  # records for each rank
    received: list[int]
    places: Tensor  # (n,) int32, of the records by Gaussian, then by rank


def send_splats(ranks: Ranks, bands: Bands, splats: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    splats: tensors with a row for each Gaussian of the rank: splats, depths, rectangles (N, 4), tile counts (N,).
    """
    reach = *splats[2:], bands.limits
    counts, *lists = OPERATORS.list_records(*reach, room := int(_ROOM * len(splats[0])))
    every = ranks.agree(counts[:-1].sum(1))
    sizes, received = every[ranks.rank], [numbers[ranks.rank] for numbers in every]
    if (total := sum(sizes)) > room:
        _, *lists = OPERATORS.list_records(*reach, total)
    gaussians, places = (numbers[:total] for numbers in lists)
    rows = ranks.send(_packed(splats, gaussians), sizes, received)[0]
    return _unpacked(rows, splats), Sent(gaussians, sizes, received, places)


def return_rows(
    ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor, inside: Tensor
) -> tuple[Tensor, Tensor]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), those of a record side by side; counts (n,) int32: of each record here; inside (n,): whether the
    record reaches no other band, so that no other rank has rows of its Gaussian. Returns the same for the rank's
    Gaussians: the rows of each in the order of ranks, which is that of its tiles; or one row, their sum, where the
    record of a Gaussian lies in one band.
    """
    kept = torch.where(inside, counts.clamp_max(1), counts)
    arrived, arrived_counts, length = _send_back(ranks, sent, rows, counts, kept)
    runs = len(sent.places)
    ends = torch.arange(runs, runs + ranks.size, dtype=torch.int32, device=rows.device)
    places = _with_last(sent.places.split(sent.sizes), ends)
    moved = move_runs(arrived, arrived_counts, places)
    nobody = torch.full((ranks.size,), count, device=rows.device)
    own = _with_last(sent.gaussians.split(sent.sizes), nobody)
    total = torch.zeros(count + 1, dtype=torch.int32, device=rows.device).index_add_(0, own, arrived_counts)
    return moved[:length], total[:-1]


def _send_back(ranks: Ranks, sent: Sent, rows: Tensor, counts: Tensor, kept: Tensor) -> tuple[Tensor, Tensor, int]:
    """Send what is kept of the rows of each record (`sum_runs` of the rasterizer), and receive those of this rank.

    Returns the rows from all ranks, by rank; the number of each record that a rank got (int32), and behind them one
    more, 1 or 0; and the number of rows without these. Such a row of zeros makes the rows of a rank even, so that all
    begin at a multiple of 16 bytes: else NCCL takes longer.
    """
    odd = _sums_of_parts(kept, sent.received).remainder(2).int()
    kept = _with_last(kept.split(sent.received), odd)
    counts = _with_last(counts.split(sent.received), torch.zeros_like(odd))
    received, sizes = ([n + 1 for n in of] for of in (sent.received, sent.sizes))
    own = ranks.send(kept, received, sizes)[0]
    more = torch.stack([part[-1] for part in own.split(sizes)])
    sums = _sums_of_parts(own, sizes), _sums_of_parts(kept, received)
    numbers = read_later(torch.cat((*sums, more.long())))
    summed = OPERATORS.sum_runs(rows, counts, kept, len(rows) + ranks.size)  # before the host waits
    found = numbers()
    padded, to_send, rest = (found[part * ranks.size : (part + 1) * ranks.size] for part in range(3))
    arrived = ranks.send(summed[: sum(to_send)], to_send, padded)[0]
    return arrived, own, sum(padded) - sum(rest)


def _with_last(parts: Sequence[Tensor], last: Tensor) -> Tensor:
    """The parts one after the other, each with one number of `last` behind it."""
    return torch.cat([piece for pair in zip(parts, last.split(1), strict=True) for piece in pair])


def _packed(splats: Sequence[Tensor], gaussians: Tensor) -> Tensor:
    """A row of words of 32 bits for each Gaussian."""
    words = _words(splats)
    rows = torch.empty(len(gaussians), sum(words), dtype=torch.int32, device=gaussians.device)
    for columns, wide, t in zip(rows.split(words, 1), words, splats, strict=True):
        # Into a part of each row: whole rows of 16 bytes are a block of threads each for torch (2.9 ms of 3 M).
        torch.index_select(t.view(torch.int32).view(len(t), wide), 0, gaussians, out=columns)
    return rows


def _unpacked(rows: Tensor, like: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The tensors that `_packed` has packed."""
    parts = zip(rows.split(_words(like), 1), like, strict=True)
    return tuple(part.contiguous().view(-1).view(t.dtype).view(len(rows), *t.shape[1:]) for part, t in parts)


def _words(tensors: Sequence[Tensor]) -> list[int]:
    """Words of 32 bits in a row of each."""
    return [t.shape[1:].numel() * t.element_size() // 4 for t in tensors]


def move_runs(rows: Tensor, counts: Tensor, places: Tensor) -> Tensor:
    """Rows in another order of their runs. counts, places (n,) int32: rows of each run, its number in the new order."""
    places = places.long()
    ends = torch.empty_like(counts).index_copy_(0, places, counts).cumsum(0).index_select(0, places)
    shifts = (ends - counts.cumsum(0)).repeat_interleave(counts, output_size=len(rows))
    return torch.empty_like(rows).index_copy_(0, torch.arange(len(rows), device=rows.device) + shifts, rows)


def _sums_of_parts(counts: Tensor, sizes: Sequence[int]) -> Tensor:
    """Sums of so many counts each, one part after the other: (parts,) int64."""
    upto = F.pad(counts.cumsum(0), (1, 0))
    return torch.stack([upto[end] for end in accumulate(sizes, initial=0)]).diff()
