"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from gaussian_renderer.over_ranks.bands import Bands
from utils.ranks.ranks import Ranks

_WORDS = {4: torch.int32, 8: torch.int64}


@dataclass(slots=True)
class Sent:
    """Which of a rank's own Gaussians each rank got, as a record, and how many records this one got from each."""

    indices: Tensor  # (n,) of the Gaussians, ascending for each rank, rank after rank
    sizes: list[int]  # records for each rank
    received: list[int]
    order: Tensor | None  # (n,): places of the records, if those of a Gaussian lie side by side; None if they do


def send_splats(
    ranks: Ranks, bands: Bands, seen: Tensor, splats: tuple[Tensor, ...]
) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    seen: (n,) the Gaussians that have tiles. splats: tensors with a row for each Gaussian of the rank: splats, depths,
    rectangles (N, 4), tile counts (N,).
    """
    top, bottom = splats[2].index_select(0, seen)[:, 1::2].unbind(1)
    borders = torch.tensor(bands.borders).to(top.device, non_blocking=True)[:, None]
    first, end = borders[:-1], borders[1:]
    reached = (top < end) & (bottom > first) & (first < end)  # (size, n)
    sizes = bands.splats[ranks.rank]
    band, place = torch.nonzero_static(reached, size=sum(sizes)).unbind(1)
    each = reached.sum(0)
    earlier = reached.cumsum(0, dtype=torch.int32)[band, place] - 1  # records of the same splat
    order = (each.cumsum(0) - each).index_select(0, place) + earlier
    indices = seen.index_select(0, place)
    counts = [splats_of[ranks.rank] for splats_of in bands.splats]
    rows, received = ranks.send(_packed(splats, indices), sizes, counts)
    return _unpacked(rows, splats), Sent(indices, sizes, received, order)


def send_views(
    ranks: Ranks, views: Sequence[tuple[Tensor, ...]], chosen: Sequence[Tensor], count: int
) -> tuple[tuple[Tensor, ...], Sent]:
    """Send rows `chosen[r]` of the tensors `views[r]` to rank r; receive this rank's, in the order of ranks.

    count: of the rank's Gaussians. The records are those of Gaussian v * count + i for Gaussian i of view v.
    """
    sizes = list(map(len, chosen))
    packed = [_packed(tensors, indices) for tensors, indices in zip(views, chosen, strict=True)]
    rows, received = ranks.send(torch.cat(packed), sizes)
    indices = torch.cat([own + view * count for view, own in enumerate(chosen)])
    return _unpacked(rows, views[0]), Sent(indices, sizes, received, None)


def return_rows(ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all ranks.

    rows: (R, V), those of a record side by side; counts (n,) int32: of each record here. Returns the same for the
    rank's Gaussians, each with its rows in the order of ranks, which is that of its tiles.
    """
    values, word = rows.shape[1], _WORDS[rows.element_size()]
    lengths = [values * n for n in _sums(counts, sent.received)]
    pairs = zip(counts.to(word).view(rows.dtype).split(sent.received), rows.view(-1).split(lengths), strict=True)
    sizes = [records + length for records, length in zip(sent.received, lengths, strict=True)]
    words, sizes = ranks.send(torch.cat(list(chain(*pairs))), sizes)
    parts = words.split(list(chain(*((records, n - records) for records, n in zip(sent.sizes, sizes, strict=True)))))
    counts, rows = torch.cat(parts[::2]).view(word).long(), torch.cat(parts[1::2]).view(-1, values)
    total = torch.zeros(count, dtype=torch.int64, device=rows.device).index_add_(0, sent.indices, counts)
    if sent.order is not None:
        rows = _by_gaussian(rows, counts, sent.order)
    return rows, total.int()


def _sums(counts: Tensor, sizes: Sequence[int]) -> list[int]:
    """The sums of runs of counts, waiting once for a GPU."""
    ends = torch.tensor([0, *sizes]).cumsum(0).to(counts.device, non_blocking=True)
    return torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int64), (1, 0)).index_select(0, ends).diff().tolist()


def _by_gaussian(rows: Tensor, counts: Tensor, order: Tensor) -> Tensor:
    """Rows (R, V), `counts` (n,) of each record, with the records put into their places."""
    ordered = torch.empty_like(counts).index_copy_(0, order, counts)
    begins = (ordered.cumsum(0) - ordered).index_select(0, order)
    shift = begins - (counts.cumsum(0) - counts)
    places = torch.arange(len(rows), device=rows.device) + shift.repeat_interleave(counts, output_size=len(rows))
    return torch.empty_like(rows).index_copy_(0, places, rows)


def _packed(tensors: tuple[Tensor, ...], indices: Tensor) -> Tensor:
    """Rows of bytes."""
    return torch.cat(
        [t.index_select(0, indices).reshape(len(indices), _columns(t)).view(torch.uint8) for t in tensors], 1
    )


def _unpacked(rows: Tensor, like: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    widths = [_columns(t) * t.element_size() for t in like]
    parts = rows.split(widths, 1)
    return tuple(
        part.contiguous().view(-1).view(t.dtype).view(len(rows), *t.shape[1:])
        for part, t in zip(parts, like, strict=True)
    )


def _columns(t: Tensor) -> int:
    return t.shape[1:].numel()
