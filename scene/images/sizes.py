"""Sizes of images: the size that a photo trains at, and smaller images by area averages.

The training size follows the reference's rules with its rounding. In an area average a pixel is the mean of what it
covers, each part weighted by its area; all sums are of whole numbers, or add in a fixed order, so they are the same on
every device.
"""

import functools
import sys

import torch
from torch import Tensor

from utils.system_utils import UserError

WIDEST = 1600
LARGEST = 16384  # pixels a side; a larger -r is more likely a typing error than a plan for a machine with that memory
FULL = 255


def training_size(width: int, height: int, resolution: int, scale: float = 1.0) -> tuple[int, int]:
    """Size (width, height) in pixels at which a photo of the given file size trains, at least 1 x 1.

    resolution: option -r. 1, 2, 4 and 8 divide, rounding half to even. -1 limits the width to 1600 pixels, any other
    value is the width; both truncate. scale: divides the size further. UserError above LARGEST pixels a side.
    """
    if resolution > LARGEST:
        raise UserError(f"--resolution (-r) {resolution} is too wide; give at most {LARGEST} pixels")
    if resolution in (1, 2, 4, 8):
        size = round(width / (scale * resolution)), round(height / (scale * resolution))
    else:
        if resolution != -1:
            factor = width / resolution
        elif width > WIDEST:
            _print_notice()
            factor = width / WIDEST
        else:
            factor = 1.0
        size = int(width / (factor * scale)), int(height / (factor * scale))
    if max(size) > LARGEST:
        raise UserError(
            f"a photo of {width} x {height} pixels would train at {size[0]} x {size[1]} with --resolution (-r) "
            f"{resolution}, but at most {LARGEST} a side are allowed; choose another resolution"
        )
    return max(size[0], 1), max(size[1], 1)


@functools.cache
def _print_notice() -> None:
    # Cached: printed once per process, not once per photo.
    print(f"photos wider than {WIDEST} pixels are shrunk to that width; -r 1 keeps their size", file=sys.stderr)


def shrink_photo(pixels: Tensor, size: tuple[int, int], mask_alpha: bool = False) -> Tensor:
    """A photo (3 or 4,H,W) at a smaller size (width, height): uint8 with straight alpha, or float multiplied by it.

    Straight alpha weights the colours. mask_alpha: alpha tells which pixels count; then only those do that cover no
    other, as in `shrink_mask`.
    """
    if pixels.is_floating_point():
        return shrink_values(pixels, size)
    if len(pixels) == 4 and mask_alpha:
        return torch.cat(
            [_divide_rounded(_sum_areas(pixels[:3], size), _count_pixels(pixels)), shrink_mask(pixels[3:], size)]
        )
    if len(pixels) == 4:
        alpha = pixels[3:].int()
        weights = _sum_areas(alpha, size)
        colors = _divide_rounded(_sum_areas(pixels[:3].int() * alpha, size), weights.clamp_min(1))
        return torch.cat([colors, _divide_rounded(weights, _count_pixels(pixels))])
    return _divide_rounded(_sum_areas(pixels, size), _count_pixels(pixels))


def shrink_mask(mask: Tensor, size: tuple[int, int]) -> Tensor:
    """A mask (1,H,W) uint8 at a smaller size: 255 where all that a pixel covers is 255, else 0."""
    return torch.where(_sum_areas(mask, size) == FULL * _count_pixels(mask), FULL, 0).to(torch.uint8)


def shrink_values(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Values (C,H,W) float32 at a smaller size, as the depth map of a view."""
    return (_sum_areas(values.double(), size) / _count_pixels(values)).to(values.dtype)


def _count_pixels(pixels: Tensor) -> int:
    return pixels.shape[-2] * pixels.shape[-1]


def _divide_rounded(sums: Tensor, parts: Tensor | int) -> Tensor:
    return torch.div(sums + parts // 2, parts, rounding_mode="floor").to(torch.uint8)


def _sum_areas(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Sums (C,h,w) over what each pixel covers, times the number of pixels of the picture."""
    whole = not pixels.is_floating_point()
    # Rows of 16384 products of two bytes fit into 32 bits; their sums do not.
    rows = _sum_along(pixels.int() if whole else pixels, 1, size[1])
    return _sum_along(rows.long() if whole else rows, 2, size[0])


def _sum_along(pixels: Tensor, axis: int, new: int) -> Tensor:
    """Sums along an axis of n pixels to `new` ones, with weights that add up to n."""
    old = pixels.shape[axis]
    # In units of 1 / new pixels, an old pixel is `new` long, and a new one `old`.
    first = torch.arange(new) * old // new
    most = int(((torch.arange(1, new + 1) * old - 1) // new - first).max()) + 1
    total: Tensor | None = None
    for place in range(most):
        index = first + place
        begin = torch.maximum(torch.arange(new) * old, index * new)
        end = torch.minimum(torch.arange(1, new + 1) * old, (index + 1) * new)
        weights = (end - begin).clamp_min(0).to(pixels.device, pixels.dtype)
        part = pixels.index_select(axis, index.clamp_max(old - 1).to(pixels.device))
        part = part * (weights[:, None] if axis == 1 else weights)
        total = part if total is None else total + part
    return total
