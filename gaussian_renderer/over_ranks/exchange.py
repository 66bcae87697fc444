"""Exchange of what ranks need of each other in a view: splats for the bands that they reach, gradient rows back."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from utils.ranks.ranks import Ranks


@dataclass(slots=True)
class Sent:
    """Which of a rank's own Gaussians each band got, and how many Gaussians this band got from each rank."""

    indices: list[Tensor]  # ascending, for each rank
    received: list[int]


def send_splats(ranks: Ranks, bands: list[int], splats: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send splats to the bands that their rectangles reach; receive those of this band, in the order of all Gaussians.

    splats: tensors with a row for each Gaussian of the rank: splats, depths, rectangles (N, 4), tile counts (N,).
    """
    _, _, rects, tile_counts = splats
    top, bottom = rects[:, 1], rects[:, 3]
    indices = [
        ((tile_counts > 0) & (top < end) & (bottom > begin)).nonzero().reshape(-1)
        for begin, end in zip(bands, bands[1:], strict=False)
    ]
    return send(ranks, [splats] * ranks.size, indices)


def send(ranks: Ranks, splats: Sequence[tuple[Tensor, ...]], indices: list[Tensor]) -> tuple[tuple[Tensor, ...], Sent]:
    """Send rows `indices[r]` of the tensors `splats[r]` to rank r; receive this rank's, in the order of ranks."""
    parts = [_packed(tensors, chosen) for tensors, chosen in zip(splats, indices, strict=True)]
    received = ranks.exchange(parts)
    return _unpacked(torch.cat(received), splats[0]), Sent(indices, list(map(len, received)))


def return_rows(ranks: Ranks, sent: Sent, count: int, rows: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Send gradient rows back; receive those of the rank's own `count` Gaussians from all bands.

    rows: (R, V), those of a splat side by side; counts (n,) int32: of each splat of this band. Returns the same for the
    rank's Gaussians, each with its rows in the order of bands, which is that of its tiles.
    """
    by_rank = counts.split(sent.received)
    lengths = torch.stack([part.sum() for part in by_rank]).tolist()
    counts_back = ranks.exchange(by_rank)
    rows_back = ranks.exchange(rows.split(lengths))
    total = torch.zeros(count, dtype=torch.int64, device=rows.device)
    for indices, part in zip(sent.indices, counts_back, strict=True):
        total.index_add_(0, indices, part.long())
    place = total.cumsum(0) - total  # of each Gaussian's next row
    out = rows.new_empty(sum(map(len, rows_back)), rows.shape[1])
    for indices, part, values in zip(sent.indices, counts_back, rows_back, strict=True):
        part = part.long()
        shift = place.index_select(0, indices) - (part.cumsum(0) - part)
        out[torch.arange(len(values), device=rows.device) + shift.repeat_interleave(part)] = values
        place.index_add_(0, indices, part)
    return out, total.int()


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
