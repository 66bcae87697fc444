"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back.

What a GPU computes is read by the host, which then waits, as rarely as can be: once to learn how many records all ranks
send, and once how many gradient rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

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
    places: Tensor | None  # (n,) int32, by Gaussian, then by rank; None: as the records lie


def agree_on_sizes(ranks: Ranks, counts: Tensor) -> tuple[list[int], list[int]]:
    """How many records this rank sends to each rank, and how many it receives. counts: (size, n), those to each."""
    every = ranks.agree(counts.sum(1))
    return every[ranks.rank], [numbers[ranks.rank] for numbers in every]


def send_splats(ranks: Ranks, bands: Bands, splats: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    splats: tensors with a row for each Gaussian of the rank: splats, depths, rectangles (N, 4), tile counts (N,).
    """
    reach = *splats[2:], bands.limits
    counts, *lists = OPERATORS.list_records(*reach, room := int(_ROOM * len(splats[0])))
    sizes, received = agree_on_sizes(ranks, counts[:-1])
    if (total := sum(sizes)) > room:
        _, *lists = OPERATORS.list_records(*reach, total)
    gaussians, places = (numbers[:total] for numbers in lists)
    rows = ranks.send(_packed([splats], gaussians, [len(gaussians)]), sizes, received)[0]
    return _unpacked(rows, splats), Sent(gaussians, sizes, received, places)


def send_views(ranks: Ranks, views: Sequence[tuple[Tensor, ...]]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send what has tiles in view r to rank r; receive this rank's, in the order of ranks.

    views: for each, tensors as of `send_splats`.
    """
    reached = torch.stack([tensors[-1] for tensors in views]) > 0
    sizes, received = agree_on_sizes(ranks, reached)
    gaussian = torch.nonzero_static(reached, size=sum(sizes))[:, 1].contiguous()
    rows = ranks.send(_packed(views, gaussian, sizes), sizes, received)[0]
    return _unpacked(rows, views[0]), Sent(gaussian, sizes, received, None)


def return_rows(
    ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor, inside: Tensor
) -> tuple[Tensor, Tensor]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), those of a record side by side; counts (n,) int32: of each record here; inside (n,): whether the
    record reaches no other band, so that no other rank has rows of its Gaussian. Returns the same for the rank's
    Gaussians: the rows of each in the order of ranks, which is that of its tiles; or one row, their sum, where the
    record of a Gaussian lies in one band.
    """
    arrived = _send_back(ranks, sent, rows, counts, torch.where(inside, counts.clamp_max(1), counts))
    runs = len(sent.places)
    ends = torch.arange(runs, runs + ranks.size, dtype=torch.int32, device=rows.device)
    places = _with_last(sent.places.split(sent.sizes), ends)
    moved = move_runs(arrived.rows, arrived.counts, places)
    nobody = torch.full((ranks.size,), count, device=rows.device)
    own = _with_last(sent.gaussians.split(sent.sizes), nobody)
    total = torch.zeros(count + 1, dtype=torch.int32, device=rows.device).index_add_(0, own, arrived.counts)
    return moved[: sum(arrived.lengths)], total[:-1]


def return_sums(ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Send back one gradient row for each record of `send_views` that has any, their sum; receive those of other ranks.

    Returns for each view the rows of the rank's own `count` Gaussians, and how many each has: one or none.
    """
    arrived = _send_back(ranks, sent, rows, counts, counts.clamp_max(1))
    counts = arrived.counts.split([n + 1 for n in sent.sizes])
    views = zip(sent.gaussians.split(sent.sizes), counts, arrived.rows.split(arrived.padded), strict=True)
    found = []
    for (own, of_view, part), length in zip(views, arrived.lengths, strict=True):
        total = torch.zeros(count, dtype=torch.int32, device=rows.device)
        found.append((part[:length], total.index_add_(0, own, of_view[:-1])))
    return found


class _Arrived(NamedTuple):
    """Rows from all ranks, by rank, of each an even number, so that all begin at a multiple of 16 bytes."""

    rows: Tensor
    counts: Tensor  # int32 of each record that a rank got, and behind them one more row, of zeros, or none
    lengths: list[int]  # without these
    padded: list[int]  # with them


def _send_back(ranks: Ranks, sent: Sent, rows: Tensor, counts: Tensor, kept: Tensor) -> _Arrived:
    """Send what is kept of the rows of each record (`sum_runs` of the rasterizer).

    Rows that began at other places than multiples of 16 bytes took NCCL longer (docs/results/several_gpus.md).
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
    return _Arrived(arrived, own, [n - one for n, one in zip(padded, rest, strict=True)], padded)


def _with_last(parts: Sequence[Tensor], last: Tensor) -> Tensor:
    """The parts one after the other, each with one number of `last` behind it."""
    return torch.cat([piece for pair in zip(parts, last.split(1), strict=True) for piece in pair])


def _packed(views: Sequence[tuple[Tensor, ...]], gaussians: Tensor, sizes: Sequence[int]) -> Tensor:
    """A row of words of 32 bits for each Gaussian, of which the first sizes[0] are of the first view, and so on."""
    words = _words(views[0])
    rows = torch.empty(len(gaussians), sum(words), dtype=torch.int32, device=gaussians.device)
    for part, splats, own in zip(rows.split(sizes), views, gaussians.split(sizes), strict=True):
        for columns, wide, t in zip(part.split(words, 1), words, splats, strict=True):
            # Into a part of each row: whole rows of 16 bytes are a block of threads each for torch (2.9 ms of 3 M).
            torch.index_select(t.view(torch.int32).view(len(t), wide), 0, own, out=columns)
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
