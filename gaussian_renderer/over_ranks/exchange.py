"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back.

What a GPU computes is read by the host, which then waits, as rarely as can be: once to learn how many records all ranks
send, and once how many gradient rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from gaussian_renderer.over_ranks.bands import Bands
from utils.ranks.ranks import Ranks


@dataclass(slots=True)
class Sent:
    """Which of a rank's own Gaussians each rank got, as a record, and how many records this one got from each."""

    gaussians: Tensor  # (n,), ascending for each rank, rank after rank
    sizes: list[int]  # records for each rank
    received: list[int]
    places: Tensor | None  # (n,) int64, ascending by Gaussian and then by rank; None if the records lie in this order


def find_records(ranks: Ranks, reached: Tensor) -> tuple[Tensor, Tensor, list[int], list[int]]:
    """The records that this rank sends, and how many it sends to and receives from each rank.

    reached: (size, N) bool, which Gaussians each rank gets. Returns the rank and the Gaussian of each record, (n,)
    int64, ascending by rank and then by Gaussian.
    """
    every = ranks.agree(reached.sum(1))
    sizes, received = every[ranks.rank], [numbers[ranks.rank] for numbers in every]
    rank, gaussian = torch.nonzero_static(reached, size=sum(sizes)).unbind(1)
    return rank, gaussian, sizes, received


def send_splats(ranks: Ranks, bands: Bands, splats: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    splats: tensors with a row for each Gaussian of the rank: splats, depths, rectangles (N, 4), tile counts (N,).
    """
    reached = bands.reached(*splats[2:])
    rank, gaussian, sizes, received = find_records(ranks, reached)
    # Gaussians are numbered without those that no band gets, so that memory is for records only.
    numbers = reached.any(0).cumsum(0, dtype=torch.int32).index_select(0, gaussian)
    places = rank.add(numbers, alpha=ranks.size)
    rows = ranks.send(_packed(splats, gaussian), sizes, received)[0]
    return _unpacked(rows, splats), Sent(gaussian, sizes, received, places)


def send_views(ranks: Ranks, views: Sequence[tuple[Tensor, ...]]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send what has tiles in view r to rank r; receive this rank's, in the order of ranks.

    views: for each, tensors with a row for each of the rank's N Gaussians, the last one tile counts. The records are
    those of Gaussian v N + i for Gaussian i of view v.
    """
    reached = torch.stack([tensors[-1] for tensors in views]) > 0
    view, gaussian, sizes, received = find_records(ranks, reached)
    packed = [_packed(tensors, own) for tensors, own in zip(views, gaussian.split(sizes), strict=True)]
    rows = ranks.send(torch.cat(packed), sizes, received)[0]
    return _unpacked(rows, views[0]), Sent(gaussian.add(view, alpha=reached.shape[1]), sizes, received, None)


def return_rows(ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), those of a record side by side; counts (n,) int32: of each record here. Returns the same for the
    rank's Gaussians, each with its rows in the order of ranks, which is that of its tiles; and how many rows came from
    each rank.
    """
    own = ranks.send(counts, sent.received, sent.sizes)[0]
    total = torch.zeros(count, dtype=torch.int32, device=rows.device).index_add_(0, sent.gaussians, own)
    shifts = None if sent.places is None else _shifts(own, sent.places, ranks.size)  # found before the host waits
    sums = _sums(torch.cat((own, counts)), [*sent.sizes, *sent.received])
    lengths, sizes = sums[: ranks.size], sums[ranks.size :]
    arrived = ranks.send(rows, sizes, lengths)[0]
    if shifts is not None:
        places = torch.arange(len(arrived), device=rows.device)
        places += shifts.repeat_interleave(own, output_size=len(arrived))
        arrived = torch.empty_like(arrived).index_copy_(0, places, arrived)
    return arrived, total, lengths


def _sums(counts: Tensor, sizes: Sequence[int]) -> list[int]:
    """The sums of runs of counts, waiting once for a GPU."""
    ends = list(accumulate(sizes))
    if not ends[-1]:
        return [0] * len(sizes)
    last = torch.tensor([max(end - 1, 0) for end in ends]).to(counts.device, non_blocking=True)
    upto = counts.cumsum(0).index_select(0, last).tolist()
    upto = [0, *(number if end else 0 for number, end in zip(upto, ends, strict=True))]
    return [end - begin for begin, end in zip(upto, upto[1:], strict=False)]


def _shifts(counts: Tensor, places: Tensor, each: int) -> Tensor:
    """How far the rows of each record move to come into the order of places: (n,) int32.

    counts: (n,), rows of each record; places: (n,), different numbers below (n + 1) * each.
    """
    by_place = counts.new_zeros((len(counts) + 1) * each).index_copy_(0, places, counts)
    ends = by_place.cumsum(0, dtype=torch.int32).index_select(0, places)
    return ends.sub_(counts.cumsum(0, dtype=torch.int32))


def _packed(tensors: tuple[Tensor, ...], indices: Tensor) -> Tensor:
    """Rows of words of 32 bits."""
    return torch.cat([t.index_select(0, indices).view(len(indices), _columns(t)).view(torch.int32) for t in tensors], 1)


def _unpacked(rows: Tensor, like: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    parts = rows.split([_columns(t) * t.element_size() // 4 for t in like], 1)
    return tuple(
        part.contiguous().view(t.dtype).view(len(rows), *t.shape[1:]) for part, t in zip(parts, like, strict=True)
    )


def _columns(t: Tensor) -> int:
    return t.shape[1:].numel()
