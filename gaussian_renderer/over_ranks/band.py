"""A rank's band of a view: forward to the whole image, and back to the gradient rows of the rank's Gaussians."""

from dataclasses import dataclass
from typing import Any

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.fakes import TILE
from diff_gaussian_rasterization.schema import SCENE
from torch import Tensor

from gaussian_renderer.over_ranks.bands import find_bands, row_loads, tile_rows
from gaussian_renderer.over_ranks.exchange import Sent, return_rows, send_splats
from utils.ranks.ranks import Ranks

_HEIGHT, _WIDTH = SCENE.index("height"), SCENE.index("width")


@dataclass(slots=True)
class View:
    """An image by all ranks, and what the way back needs."""

    ranks: Ranks
    color: Tensor  # (3, H, W)
    transmittance: Tensor  # (1, H, W)
    inverse_depth: Tensor  # (1, H, W), or no rows if it is not wanted
    radii: Tensor  # (N,) of the rank's own Gaussians
    splats: Tensor  # (N, 10)
    tile_counts: Tensor  # (N,)
    sent: Sent
    state: tuple[Tensor, ...]  # of the band: splats, instances, ranges, splat_slots, slots, background, last, ...
    layers: Tensor


def draw_view(ranks: Ranks, scene: tuple[Any, ...], background: Tensor, want_depth: bool, train: bool) -> View:
    """Render a view with the Gaussians of all ranks. scene: the rasterizer's arguments with the rank's own ones.

    Every rank gets the image of one process, to the bit.
    """
    height, width = scene[_HEIGHT], scene[_WIDTH]
    own, depths, rects, tile_counts, radii = OPERATORS.project(*scene)
    bands = find_bands(ranks, row_loads(rects, tile_counts, height, width), width)
    (splats, depths, rects, counts), sent = send_splats(ranks, bands, (own, depths, rects, tile_counts))
    instances, ranges, *slots = OPERATORS.bin(splats, depths, rects, counts, height, width, train)
    begin, end = bands[ranks.rank], bands[ranks.rank + 1]
    across = (len(ranges) - 1) // tile_rows(height)
    ranges = ranges.clamp(ranges[begin * across], ranges[end * across])  # lists of other bands become empty
    color, transmittance, inverse_depth, last, layers = OPERATORS.blend(
        splats, instances, ranges, background, height, width, want_depth, train
    )
    planes = torch.cat((color, transmittance, inverse_depth))
    rows = planes[:, begin * TILE : end * TILE].transpose(0, 1).contiguous()
    image = ranks.gather(rows).transpose(0, 1).contiguous()
    state = (splats, instances, ranges, *slots, background, last, transmittance)
    return View(ranks, image[:3], image[3:4], image[4:], radii, own, tile_counts, sent, state, layers)


def gradient_rows(
    view: View, gradients: tuple[Tensor, Tensor | None, Tensor | None], absolute: bool
) -> tuple[Tensor, Tensor]:
    """The gradient rows of the rank's own Gaussians, and how many each has, from the gradients of the image.

    gradients: of colour, transmittance and inverse depth, whole on every rank.
    """
    rows, counts = OPERATORS.blend_rows(*view.state, *gradients, view.layers, absolute)
    return return_rows(view.ranks, view.sent, len(view.radii), rows, counts)


def decisive_in(view: View) -> Tensor:
    """The rank's own Gaussians that the image depends on (`decisive` of diff_gaussian_rasterization): (N,) bool."""
    splats, instances, ranges, *_, last, _ = view.state
    by_band = view.ranks.exchange(OPERATORS.decisive(splats, instances, ranges, last).split(view.sent.received))
    found = torch.zeros(len(view.radii), dtype=torch.bool, device=splats.device)
    for indices, part in zip(view.sent.indices, by_band, strict=True):
        found[indices] |= part
    return found
