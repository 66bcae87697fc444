"""The division of an image's rows of tiles into bands, one for each rank."""

import torch
from diff_gaussian_rasterization.fakes import TILE
from torch import Tensor

from utils.ranks.ranks import Ranks

_TILE_COST = 8  # of a tile without instances, in instances


def tile_rows(height: int) -> int:
    """Rows of tiles of an image of so many pixels."""
    return -(-height // TILE)


def row_loads(rects: Tensor, tile_counts: Tensor, height: int, width: int) -> Tensor:
    """How much work each row of tiles is: (rows,) int64, from rectangles (N, 4) and numbers (N,) of splats' tiles.

    A splat counts with the width of its rectangle in each of its rows.
    """
    seen = (tile_counts > 0).nonzero().reshape(-1)
    left, top, right, bottom = rects.index_select(0, seen).long().unbind(1)
    wide = right - left
    steps = torch.zeros(tile_rows(height) + 1, dtype=torch.int64, device=rects.device)
    steps.index_add_(0, top, wide).index_add_(0, bottom, wide, alpha=-1)
    return steps[:-1].cumsum(0)


def find_bands(ranks: Ranks, loads: Tensor, width: int) -> list[int]:
    """Where each rank's band begins, in rows of tiles, and where the last one ends: size + 1 numbers.

    loads: `row_loads` of the rank's own Gaussians. Bands have about equal loads. The division decides no bit of a
    result, but all ranks must know the same one.
    """
    total = ranks.numbers(*loads.tolist()).sum(0) + _TILE_COST * tile_rows(width)
    ends = total.cumsum(0)
    shares = torch.arange(1, ranks.size) * int(ends[-1]) // ranks.size
    # A row belongs to the band in which its middle lies.
    cuts = torch.searchsorted(2 * ends - total, 2 * shares)
    return [0, *cuts.tolist(), len(total)]
