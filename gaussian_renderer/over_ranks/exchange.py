"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back.

What a GPU computes is read by the host, which then waits, as rarely as can be: once to learn how many records all ranks
send, and once how many gradient rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from gaussian_renderer.over_ranks.bands import Bands
from utils.ranks.ranks import Ranks


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
    counts = OPERATORS.count_records(*reach)
    sizes, received = agree_on_sizes(ranks, counts[:-1])
    gaussians, places = OPERATORS.list_records(*reach, counts, sum(sizes))
    rows = ranks.send(_packed([splats], gaussians, [len(gaussians)]), sizes, received)[0]
    return OPERATORS.unpack_splats(rows, splats[0]), Sent(gaussians, sizes, received, places)


def send_views(ranks: Ranks, views: Sequence[tuple[Tensor, ...]]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send what has tiles in view r to rank r; receive this rank's, in the order of ranks.

    views: for each, tensors as of `send_splats`. The records are those of Gaussian v N + i for Gaussian i of view v, of
    the rank's N Gaussians.
    """
    reached = torch.stack([tensors[-1] for tensors in views]) > 0
    sizes, received = agree_on_sizes(ranks, reached)
    view, gaussian = torch.nonzero_static(reached, size=sum(sizes)).unbind(1)
    rows = ranks.send(_packed(views, gaussian, sizes), sizes, received)[0]
    records = gaussian.add(view, alpha=reached.shape[1])
    return OPERATORS.unpack_splats(rows, views[0][0]), Sent(records, sizes, received, None)


def return_rows(ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), those of a record side by side; counts (n,) int32: of each record here. Returns the same for the
    rank's Gaussians, each with its rows in the order of ranks, which is that of its tiles; and how many rows came from
    each rank.
    """
    own = ranks.send(counts, sent.received, sent.sizes)[0]
    total = torch.zeros(count, dtype=torch.int32, device=rows.device).index_add_(0, sent.gaussians, own)
    sums = _sums(torch.cat((own, counts)), [*sent.sizes, *sent.received])
    lengths, sizes = sums[: ranks.size], sums[ranks.size :]
    arrived = ranks.send(rows, sizes, lengths)[0]
    if sent.places is not None:
        arrived = OPERATORS.move_runs(arrived, own, sent.places)
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


def _packed(views: Sequence[tuple[Tensor, ...]], gaussians: Tensor, sizes: Sequence[int]) -> Tensor:
    """A row of words of 32 bits for each Gaussian, of which the first sizes[0] are of the first view, and so on."""
    words = sum(t.shape[1:].numel() * t.element_size() for t in views[0]) // 4
    rows = torch.empty(len(gaussians), words, dtype=torch.int32, device=gaussians.device)
    for part, splats, own in zip(rows.split(sizes), views, gaussians.split(sizes), strict=True):
        OPERATORS.pack_splats_(part, *splats, own)
    return rows
