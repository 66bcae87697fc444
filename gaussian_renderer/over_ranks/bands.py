"""The division of an image's rows of tiles into bands, one for each rank, which blends it."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from diff_gaussian_rasterization.fakes import TILE
from fused_ssim import REACH
from torch import Tensor

from groundwork.ranks.ranks import Ranks

# Work in units of a rectangle's width in a row: of an instance that the backward reads, and of a tile besides. On
# one GPU a width, with 3.43 to a splat of 2.94 instances, takes 0.02 to 0.045 us, an instance 0.38 us and its row about
# 0.1, and a tile of 256 pixels 68 us, all for a thousand.
_PROCESSED_COST, _TILE_COST = 11, 1500
_VISITS = 8  # of a view, for which its bands are kept
_SAMPLE = 1 << 16  # splats of a rank, about, by which bands are found
_NOWHERE = 1 << 30  # a row of tiles that no rectangle reaches


class Bands:
    """The bands of all ranks, the same on every rank. Results do not depend on them.

    borders: the first row of tiles of each band, and the end of the last one: size + 1 numbers.
    height: height of the image, pixels.
    device: device of the tensors.
    rank: number of this rank.
    """

    def __init__(self, borders: Sequence[int], height: int, rank: int, device: torch.device) -> None:
        self.borders, self.height = list(borders), height
        self._rank, self._device = rank, device

    @property
    def own(self) -> range:
        """The rows of tiles of this rank's band."""
        return range(*self.borders[self._rank : self._rank + 2])

    def pixels(self, rank: int, reach: int = 0) -> tuple[int, int]:
        """The first and the end row of pixels of a band, with `reach` more on either side unless the band is empty."""
        first, end = (min(TILE * border, self.height) for border in self.borders[rank : rank + 2])
        return (max(first - reach, 0), min(end + reach, self.height)) if first < end else (first, end)

    @cached_property
    def limits(self) -> Tensor:
        """First and end row of tiles of each band: (2, size) int32; an empty band contains no row."""
        pairs = [(a, b) if a < b else (_NOWHERE, -1) for a, b in zip(self.borders, self.borders[1:], strict=False)]
        return torch.tensor(pairs, dtype=torch.int32).T.contiguous().to(self._device)

    @cached_property
    def halo(self) -> tuple["Rows", "Rows"]:
        """The rows of pixels that other ranks' losses read of this band, and this rank's loss of theirs."""
        own, wide = self.pixels(self._rank), self.pixels(self._rank, REACH)
        others = [rank for rank in range(len(self.borders) - 1) if rank != self._rank]
        given = {rank: _intersect(own, self.pixels(rank, REACH)) for rank in others}
        taken = {rank: _intersect(self.pixels(rank), wide) for rank in others}
        return tuple(Rows(parts | {self._rank: range(0)}, self._device) for parts in (given, taken))


class Rows:
    """Rows of pixels for ranks 0, 1 and so on. indices: (n,), on a device. sizes: number of rows for each rank."""

    def __init__(self, parts: dict[int, range], device: torch.device) -> None:
        self.sizes = [len(parts[rank]) for rank in range(len(parts))]
        self.indices = torch.tensor([row for rank in range(len(parts)) for row in parts[rank]], dtype=torch.int64)
        self.indices = self.indices.to(device)


def _intersect(one: tuple[int, int], other: tuple[int, int]) -> range:
    """Intersect two ranges of rows."""
    return range(max(one[0], other[0]), min(one[1], other[1]))


def tile_rows(height: int) -> int:
    """Number of rows of tiles of an image, `height` in pixels."""
    return -(-height // TILE)


def width_changes(rects: Tensor, tile_counts: Tensor, height: int) -> Tensor:
    """The change of the summed widths of splats at each row of tiles, and below the last one: (rows + 1,) int64.

    Of many splats every k-th one stands for k: all would add to the same few numbers, one after the other.

    rects: (N, 4), the splats' rectangles.
    tile_counts: (N,), 0 for a splat that does not count.
    """
    every = -(-len(rects) // _SAMPLE) or 1
    rows = tile_rows(height)
    # Where a splat has no tiles, its rectangle is undefined.
    left, top, right, bottom = rects[::every].long().unbind(1)
    wide = every * (right - left) * (tile_counts[::every] > 0)
    steps = torch.zeros(rows + 1, dtype=torch.int64, device=rects.device)
    return steps.index_add_(0, torch.cat((top, bottom)).clamp_(0, rows), torch.cat((wide, -wide)))


def processed_by_row(last: Tensor, rows: range) -> Tensor:
    """Number of instances that the backward reads in each row of tiles: (all rows + 1,) int64, 0 outside `rows`.

    last: (H, W), the position behind the last instance of a pixel in its tile's list.
    """
    height, width = last.shape
    total = torch.zeros(tile_rows(height) + 1, dtype=torch.int64, device=last.device)
    own = last[TILE * rows.start : TILE * rows.stop]
    padded = F.pad(own, (0, -width % TILE, 0, TILE * len(rows) - len(own)))
    tiles = padded.view(len(rows), TILE, padded.shape[1] // TILE, TILE)
    if len(rows):
        total[rows.start : rows.stop] = tiles.amax((1, 3)).sum(1)
    return total


def find_bands(
    ranks: Ranks, rects: Tensor, tile_counts: Tensor, height: int, width: int, processed: Tensor | None = None
) -> Bands:
    """Find bands of about equal work. A splat costs the width of its rectangle in each of its rows.

    rects: (N, 4), rectangles of the rank's own Gaussians.
    tile_counts: (N,), 0 for a Gaussian that does not count.
    processed: `processed_by_row` of the rank's band in an earlier visit; given by all ranks or by none.
    """
    widths = width_changes(rects, tile_counts, height)
    loads = torch.stack((widths, torch.zeros_like(widths) if processed is None else processed))
    widths, processed = ranks.all_gather(loads).sum(0).cpu()
    total = widths.cumsum(0)[:-1] + _PROCESSED_COST * processed[:-1] + _TILE_COST * tile_rows(width)
    ends = total.cumsum(0)
    shares = torch.arange(1, ranks.size) * int(ends[-1]) // ranks.size
    # A row belongs to the band in which its middle lies.
    cuts = torch.searchsorted(2 * ends - total, 2 * shares)
    return Bands([0, *cuts.tolist(), len(total)], height, ranks.rank, rects.device)


@dataclass
class _Visits:
    bands: Bands
    count: int = 0
    processed: Tensor | None = None  # in the last visit before bands are found anew


class CachedBands:
    """Bands kept for later visits of a view; work changes slowly, so they are found again only after some visits.

    All ranks have to ask for the same views in the same order.
    """

    def __init__(self) -> None:
        self._kept: dict[Hashable, _Visits] = {}

    def find(self, view: Hashable, ranks: Ranks, rects: Tensor, tile_counts: Tensor, height: int, width: int) -> Bands:
        """Return the bands of an earlier visit of the view, or find them (`find_bands`)."""
        key = view, height, width
        kept = self._kept.get(key)
        if kept is None or kept.count >= _VISITS:
            processed = kept and kept.processed
            kept = self._kept[key] = _Visits(find_bands(ranks, rects, tile_counts, height, width, processed))
        kept.count += 1
        return kept.bands

    def note_processed(self, view: Hashable, last: Tensor) -> None:
        """Note the work of the last visit before bands are found again.

        last: (H, W), the position behind the last instance of a pixel in its tile's list.
        """
        kept = self._kept[(view, *last.shape)]
        if kept.count == _VISITS:
            kept.processed = processed_by_row(last, kept.bands.own)
