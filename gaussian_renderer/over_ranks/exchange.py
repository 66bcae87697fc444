"""Exchange between ranks in a view: splats to the bands that they reach, gradient rows back.

The host waits for a GPU only twice: to read the numbers of records that ranks send, and of gradient rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from gaussian_renderer.over_ranks.bands import Bands
from groundwork.host.read_later import read_later
from groundwork.ranks.ranks import Ranks

# Records for a rank are a multiple of it, so that messages of words begin at a multiple of 16 bytes: else NCCL takes
# longer.
_EVEN = 4


@dataclass(slots=True)
class Sent:
    """The Gaussians that a rank has sent to each rank, as records, and the number of records that it received.

    The last records for a rank, at least one, are empty and have the Gaussian number N.
    """

    gaussians: Tensor  # (n,), ascending for each rank, rank after rank
    sizes: list[int]  # records for each rank
    received: list[int]
    places: Tensor  # (n,) int32, of the records by Gaussian, then by rank


def send_splats(ranks: Ranks, bands: Bands, splats: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    splats: tensors with a row for each Gaussian of the rank: splats, depths, rectangles (N, 4), tile counts (N,).
    """
    reach = *splats[2:], bands.limits
    counts = OPERATORS.list_records(*reach)[0]
    empty = _EVEN - counts[:-1].sum(1).remainder(_EVEN)
    counts = torch.cat((counts, torch.cat((empty, empty.sum()[None])).int()[:, None]), 1)
    every = ranks.all_gather_ints(counts[:-1].sum(1))
    sizes, received = every[ranks.rank], [numbers[ranks.rank] for numbers in every]
    _, gaussians, places, *records = OPERATORS.list_records(*reach, counts, *splats[:2], sum(sizes))
    # One message each, so that nothing has to be taken apart: a copy of all takes longer than three more messages.
    arrived = tuple(ranks.send(rows, sizes, received)[0] for rows in records)
    return arrived, Sent(gaussians, sizes, received, places)


def return_rows(
    ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor, inside: Tensor
) -> tuple[Tensor, Tensor]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), the rows of a record side by side.
    counts: (n,) int32, number of rows of each record here.
    inside: (n,), whether the record reaches no other band, so that no other rank has rows of its Gaussian.

    Returns rows and counts for the rank's Gaussians: the rows of each in the order of ranks, which is the order of its
    tiles; or one row, their sum, where the record of a Gaussian lies in one band.
    """
    kept = torch.where(inside, counts.clamp_max(1), counts)
    arrived, own, length = _send_back(ranks, sent, rows, counts, kept)
    moved = OPERATORS.sum_runs(arrived, own, own, len(arrived), sent.places)
    total = torch.zeros(count + 1, dtype=torch.int32, device=rows.device).index_add_(0, sent.gaussians, own)
    return moved[:length], total[:-1]


def _send_back(ranks: Ranks, sent: Sent, rows: Tensor, counts: Tensor, kept: Tensor) -> tuple[Tensor, Tensor, int]:
    """Send `kept` of the rows of each record (`sum_runs` of the rasterizer), and receive those of this rank.

    Returns the rows from all ranks, by rank; the number of each record that a rank got (int32); and the number of rows
    without those of empty records. Where the rows for a rank are odd in number, its last empty record has one of zeros,
    as two rows are a multiple of 16 bytes (_EVEN).
    """
    for part in kept.split(sent.received):
        part[-1] = part.sum().remainder(2)
    own = ranks.send(kept, sent.received, sent.sizes)[0]
    more = [part[-1:] for part in own.split(sent.sizes)]
    numbers = read_later(torch.cat((_sum_parts(own, sent.sizes), _sum_parts(kept, sent.received), *more)))
    summed = OPERATORS.sum_runs(rows, counts, kept, len(rows) + ranks.size)  # before the host waits
    found = numbers()
    padded, to_send, rest = (found[part * ranks.size : (part + 1) * ranks.size] for part in range(3))
    arrived = ranks.send(summed[: sum(to_send)], to_send, padded)[0]
    return arrived, own, sum(padded) - sum(rest)


def _sum_parts(counts: Tensor, sizes: Sequence[int]) -> Tensor:
    """Sum consecutive parts of counts, of `sizes` each: (parts,) int64."""
    return torch.stack([part.sum() for part in counts.split(sizes)])
