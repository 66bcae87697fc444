"""Sort rows along a Morton curve of the means, so that neighbours in the scene are neighbours in memory.

Kernels then read and write the rows of a tile's splats in few places. Any order gives the same model up to the rounding
of sums.
"""

import torch
from torch import Tensor

from scene.gaussians.parameters import GaussianParameters

_HALF = 1 << 20  # cells of an axis on either side of the origin
_SCATTERED = 0.25  # distance of Gaussians in rows beside each other, by that of rows half of the model apart
_SPREAD = {32: 0x1F00000000FFFF, 16: 0x1F0000FF0000FF, 8: 0x100F00F00F00F00F, 4: 0x10C30C30C30C30C3,
           2: 0x1249249249249249}  # shifts and masks that leave two zeros between the bits of a cell's 21  # fmt: skip


@torch.no_grad()
def sort_rows(gaussians: GaussianParameters) -> None:
    """Put the rows, with all that belongs to them, along the curve; equal places keep their order.

    New parameters have no gradient. Every rank must call it.
    """
    scale = getattr(gaussians, "spatial_lr_scale", None) or 1.0
    gaussians.shards.sort(gaussians, morton_codes(gaussians.raw("xyz"), scale))


@torch.no_grad()
def sort_scattered(gaussians: GaussianParameters) -> None:
    """Sort rows whose neighbours in memory are far apart in the scene, as in files of other programs.

    A model that was sorted in its training keeps its order: its neighbours are some fifty times nearer to each other.
    """
    means, half = gaussians.raw("xyz"), len(gaussians) // 2
    adjacent, across = (torch.linalg.norm(means.roll(rows, 0) - means, dim=1) for rows in (1, half))
    if half and adjacent.nanmedian() > _SCATTERED * across.nanmedian():
        sort_rows(gaussians)


def morton_codes(points: Tensor, scale: float) -> Tensor:
    """Places (N,) int64 of points (N, 3) on a Morton curve (G. M. Morton 1966): the bits of their cells by turns.

    Cells are even in x / (scale + |x|), so that a far point costs the others no resolution. NaN counts as 0.
    """
    places = (points / (points.abs() + scale)).nan_to_num(0.0)
    cells = ((places + 1) * _HALF).long().clamp(0, 2 * _HALF - 1)
    for shift, mask in _SPREAD.items():
        cells = (cells | cells << shift) & mask
    x, y, z = cells.unbind(1)
    return x << 2 | y << 1 | z
