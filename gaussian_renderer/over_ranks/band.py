"""A rank's band of a view: forward to the image, and backward to the gradient rows of the rank's Gaussians.

A band is a range of rows of tiles of the image, which one rank blends. Each rank also has a part of the Gaussians. It
projects these, sends the splats to the bands that they reach, and gets back the rows of their gradients.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.scene import Drawing, Scene
from torch import Tensor

from gaussian_renderer.over_ranks.bands import Bands, find_bands, tile_rows
from gaussian_renderer.over_ranks.exchange import Sent, return_rows, send_splats
from groundwork.ranks.ranks import Ranks


class Band(NamedTuple):
    """The band of a rank as a loss by bands takes it (`photometric_loss_by_bands` of fused_ssim)."""

    rows: tuple[int, int]  # of pixels: the first one, and the one behind the last
    add: Callable[[Tensor], Tensor]  # sums a tensor over the bands of all ranks


@dataclass(slots=True)
class View:
    """A rank's band of a view, and the tensors for its backward. Planes have the size of the whole image."""

    ranks: Ranks
    bands: Bands
    color: Tensor  # (3, H, W), right in the rows of the band, unless `gather_image` or `exchange_halo` says more
    inverse_depth: Tensor  # (1, H, W), or no rows if it is not wanted
    radii: Tensor  # (N,) of the rank's own Gaussians
    splats: Tensor  # (N, 10), of the rank's own Gaussians
    tile_counts: Tensor  # (N,), of the rank's own Gaussians
    sent: Sent  # the records of Gaussians that the rank has sent to bands, for the way back
    inside: Tensor  # (n,) bool, the received records that reach no other band
    drawing: Drawing  # the band with the received splats
    background: Tensor

    @property
    def last(self) -> Tensor:
        """The ends of lists (H, W), valid in the rows of the band."""
        return self.drawing.last

    @property
    def band(self) -> Band:
        return Band(self.bands.pixels(self.ranks.rank), self.ranks.all_reduce_sum)


def draw_view(
    ranks: Ranks,
    scene: Scene,
    background: Tensor,
    want_depth: bool,
    train: bool,
    find: Callable[..., Bands] | None = None,
    awake: Tensor | None = None,
) -> View:
    """Render the rank's band of a view with the Gaussians of all ranks, to the same bits as one process.

    Every rank must call it. Returns the band in an image of full size: other rows are right only after `gather_image`
    or `exchange_halo`.

    scene: the rasterizer's arguments with the rank's own Gaussians.
    background: (3,).
    want_depth: true to blend the inverse depth, too.
    train: true if a backward follows, for which the lists and layers are kept.
    find: function that chooses the bands, in place of `find_bands` and with its arguments, such as `CachedBands.find`.
    awake: (blocks,) uint8, 0 for blocks of the rank's rows that sleep: the view does not show them, so they are not
        projected (scene/sleeping.py). None: all are awake.
    """
    height, width = scene.size
    own, depths, rects, tile_counts, radii = OPERATORS.project(*scene, awake)
    bands = (find or find_bands)(ranks, rects, tile_counts, height, width)
    (splats, depths, rects, counts), sent = send_splats(ranks, bands, (own, depths, rects, tile_counts))
    instances, ranges, *slots = OPERATORS.bin(splats, depths, rects, counts, height, width, train)
    begin, end = bands.borders[ranks.rank : ranks.rank + 2]
    inside = (rects[:, 1] >= begin) & (rects[:, 3] <= end)
    across = (len(ranges) - 1) // tile_rows(height)
    ranges = ranges.clamp(ranges[begin * across], ranges[end * across])  # lists of other bands become empty
    color, transmittance, inverse_depth, last, layers = OPERATORS.blend(
        splats, instances, ranges, background, height, width, want_depth, train
    )
    lists = instances, ranges, *slots
    drawing = Drawing(color, transmittance, inverse_depth, radii, splats, counts, *lists, last, layers)
    return View(ranks, bands, color, inverse_depth, radii, own, tile_counts, sent, inside, drawing, background)


def gather_image(view: View) -> View:
    """Give every rank all rows of the image, and of the inverse depth if wanted. Returns the view."""
    ranks, bands = view.ranks, view.bands
    rows = [bands.pixels(rank) for rank in range(ranks.size)]
    first, end = rows[ranks.rank]
    own = torch.cat((view.color, view.inverse_depth))[:, first:end].transpose(0, 1)
    planes = ranks.all_gather_rows(own, [end - first for first, end in rows]).transpose(0, 1).contiguous()
    view.color, view.inverse_depth = planes[:3], planes[3:]
    return view


def exchange_halo(view: View) -> View:
    """Give every rank the rows of colour around its band that its loss reads (REACH). Returns the view."""
    given, taken = view.bands.halo
    rows = view.color.transpose(0, 1).index_select(0, given.indices)
    received = view.ranks.send(rows, given.sizes, taken.sizes)[0]
    view.color.index_copy_(1, taken.indices, received.transpose(0, 1))
    return view


def gradient_rows(
    view: View, gradients: tuple[Tensor, Tensor | None, Tensor | None], absolute: bool
) -> tuple[Tensor, Tensor]:
    """Compute gradient rows of the rank's own Gaussians from gradients of the image, and return them to their ranks.

    Returns the rows, those of a Gaussian one after the other, and their number for each Gaussian (N,) (`return_rows`).

    gradients: of colour, transmittance and inverse depth, (., H, W); only the rows of the band are read.
    """
    rows, counts = OPERATORS.blend_rows(view.drawing.kept(view.background), *gradients, absolute)
    return return_rows(view.ranks, view.sent, len(view.radii), rows, counts, view.inside)


def camera_gradient(
    ranks: Ranks, scene: Scene, source: Sequence[Tensor], absolute: bool = False, blocks: Sequence[int] | None = None
) -> Tensor:
    """Return the gradient of the loss by the camera's numbers, (numbers,) float64, over the Gaussians of all ranks.

    The numbers are in the order of diff_gaussian_rasterization/camera.py. If each rank has whole blocks of rows
    (Shards), the bits are those of one process. Every rank must call it.

    source: splats, tile counts, and the result of `gradient_rows`.
    blocks: number of blocks of rows that each rank has (groundwork/ranks/rows.py); None: not known.
    """
    own = OPERATORS.camera_vjp(*scene, source, absolute)
    return OPERATORS.sum_blocks(ranks.all_gather_rows(own, blocks))


def decisive_in(view: View) -> Tensor:
    """Mark the rank's Gaussians that the image depends on (`decisive` of diff_gaussian_rasterization): (N,) bool."""
    splats, instances, ranges, sent = view.drawing.splats, view.drawing.instances, view.drawing.ranges, view.sent
    mask = OPERATORS.decisive(splats, instances, ranges, view.last)
    by_band, _ = view.ranks.send(mask, sent.received, sent.sizes)
    found = torch.zeros(len(view.radii) + 1, dtype=torch.int32, device=splats.device)
    return found.index_add_(0, sent.gaussians, by_band.int())[:-1] > 0
