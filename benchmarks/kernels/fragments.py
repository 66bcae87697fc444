"""Exact counts, made with torch, of the pixel-splat pairs (fragments) that blending evaluates and that it blends.

A splat is evaluated in every sub-tile that its alpha can reach, up to the last splat that a pixel of the sub-tile
blends. The backward evaluates exactly these. The forward also evaluates the few splats that find a pixel nearly opaque
and end it.
"""

import math

import torch
from torch import Tensor

TILE = 16
SUB_TILES = ((8, 4), (8, 8), (16, 8), (16, 16))  # width, height; those of a warp with 1, 2, 4 and 8 pixels per lane
_REACH = math.log2(255)  # alpha = 1/255 where u^2 + v^2 exceeds log2 opacity by this
_CHUNK = 1 << 16  # instances at a time


def processed_per_tile(last: Tensor) -> Tensor:
    """Return the number of processed instances of each tile, (tiles,).

    last: (H, W), the number of instances up to the last one that a pixel blends.
    """
    return _by_tile(last).amax((1, 2)).long()


def fragments(
    splats: Tensor,
    instances: Tensor,
    ranges: Tensor,
    last: Tensor,
    sub_tiles: tuple[tuple[int, int], ...] = SUB_TILES,
) -> dict[str, float]:
    """Count fragments per pixel, from the outputs of the operators project, bin and blend.

    Keys: "blended", and "8x4" and so on for the fragments evaluated with sub-tiles of that width and height.
    """
    across = -(-last.shape[1] // TILE)
    last_by_tile = _by_tile(last)
    limits = {(w, h): last_by_tile.unflatten(2, (-1, w)).unflatten(1, (-1, h)).amax((2, 4)) for w, h in sub_tiles}
    processed = processed_per_tile(last)
    tile_of = torch.repeat_interleave(torch.arange(len(processed), device=last.device), processed)
    position = torch.arange(len(tile_of), device=last.device) - (processed.cumsum(0) - processed)[tile_of]
    pairs = dict.fromkeys(("blended", *sub_tiles), 0)
    local = torch.arange(TILE, device=last.device)
    for tile, place in zip(tile_of.split(_CHUNK), position.split(_CHUNK), strict=True):
        mean_x, mean_y, l11, l12, l22, log2_opacity = splats[instances[ranges[tile] + place].long(), :6].double().T
        mean_x, mean_y = mean_x - TILE * (tile % across), mean_y - TILE * (tile // across)
        room, factor = log2_opacity + _REACH, (l11, l12, l22)
        dx = (local - mean_x[:, None])[:, None, :]
        dy = (local - mean_y[:, None])[:, :, None]
        hit = _square(tuple(value[:, None, None] for value in factor), dx, dy) <= room[:, None, None]
        pairs["blended"] += int((hit & (place[:, None, None] < last_by_tile[tile])).sum())
        for (w, h), limit in limits.items():
            reached = _least_square(factor, dx[..., ::w], dx[..., w - 1 :: w], dy[:, ::h], dy[:, h - 1 :: h])
            reached = reached <= room[:, None, None]
            pairs[w, h] += int((reached & (place[:, None, None] < limit[tile])).sum()) * w * h
    return {k if k == "blended" else "{}x{}".format(*k): n / last.numel() for k, n in pairs.items()}


def _by_tile(last: Tensor) -> Tensor:
    """(H, W) -> (tiles, 16, 16), zero outside the image."""
    height, width = last.shape
    padded = torch.nn.functional.pad(last, (0, -width % TILE, 0, -height % TILE))
    return padded.unfold(0, TILE, TILE).unfold(1, TILE, TILE).flatten(0, 1)


def _square(factor: tuple[Tensor, Tensor, Tensor], dx: Tensor, dy: Tensor) -> Tensor:
    l11, l12, l22 = factor
    return (l11 * dx + l12 * dy) ** 2 + (l22 * dy) ** 2


def _least_square(factor: tuple, x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor) -> Tensor:
    """Return the minimum of `_square` over boxes x0..x1, y0..y1: 0 if the mean is inside, else found on an edge."""
    factor = l11, l12, l22 = tuple(value[:, None, None] for value in factor)
    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    edges = [_square(factor, x, (-l11 * l12 * x / (l12**2 + l22**2)).clamp(y0, y1)) for x in (x0, x1)]
    edges += [_square(factor, (-l12 * y / l11).clamp(x0, x1), y) for y in (y0, y1)]
    return torch.stack(edges).amin(0).masked_fill(inside, 0)
