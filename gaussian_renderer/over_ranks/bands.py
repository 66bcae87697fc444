"""The division of an image's rows of tiles into bands, one for each rank."""

from dataclasses import dataclass

import torch
from diff_gaussian_rasterization.fakes import TILE
from torch import Tensor

from utils.ranks.ranks import Ranks

_TILE_COST = 8  # of a tile without instances, in instances


@dataclass(frozen=True, slots=True)
class Bands:
    """The bands of all ranks, the same on every rank. They decide no bit of a result."""

    borders: list[int]  # rows of tiles where a band begins, and where the last one ends: size + 1 numbers
    splats: list[list[int]]  # number of a rank's splats that reach a band, by rank and band
    height: int  # of the image, pixels

    def pixels(self, rank: int, reach: int = 0) -> tuple[int, int]:
        """The rows of pixels of a band, first and end, and `reach` more on either side, unless it is empty."""
        first, end = (min(TILE * border, self.height) for border in self.borders[rank : rank + 2])
        return (max(first - reach, 0), min(end + reach, self.height)) if first < end else (first, end)


def tile_rows(height: int) -> int:
    """Rows of tiles of an image of so many pixels."""
    return -(-height // TILE)


def row_steps(rects: Tensor, height: int) -> Tensor:
    """What begins and ends in each row of tiles, and below the last one: (rows + 1, 3) int64.

    rects: (n, 4), the rectangles of splats that have tiles. In each row, how many begin there, how many have ended
    above it, and by how much the sum of their widths changes.
    """
    left, top, right, bottom = rects.long().unbind(1)
    wide, one = right - left, torch.ones_like(top)
    steps = torch.zeros(3 * (tile_rows(height) + 1), dtype=torch.int64, device=rects.device)
    places = torch.cat((3 * top, 3 * bottom + 1, 3 * top + 2, 3 * bottom + 2))
    return steps.index_add_(0, places, torch.cat((one, one, wide, -wide))).view(-1, 3)


def find_bands(ranks: Ranks, rects: Tensor, height: int, width: int) -> Bands:
    """Bands of about equal loads. rects: (n, 4), of the rank's own splats that have tiles.

    A splat is as much work as its rectangle is wide, in each of its rows. All ranks tell each other what begins and
    ends where, so that they need no further word on how many splats each of them sends.
    """
    begun, ended, widths = ranks.table(row_steps(rects, height)).cpu().cumsum(1).unbind(2)  # (size, rows + 1) each
    total = widths[:, :-1].sum(0) + _TILE_COST * tile_rows(width)
    ends = total.cumsum(0)
    shares = torch.arange(1, ranks.size) * int(ends[-1]) // ranks.size
    # A row belongs to the band in which its middle lies.
    cuts = torch.searchsorted(2 * ends - total, 2 * shares)
    borders = torch.nn.functional.pad(cuts, (1, 1))
    borders[-1] = len(total)
    first, end = borders[:-1], borders[1:]
    # Those that begin above a band's end, less those that end above its begin.
    reaching = torch.nn.functional.pad(begun, (1, 0))[:, end] - ended[:, first]
    return Bands(borders.tolist(), torch.where(first < end, reaching, 0).tolist(), height)
