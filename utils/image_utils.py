"""Scores of image pairs for the training report. metrics.py has its own, of 8-bit files with one MSE per image."""

import math
from collections.abc import Iterable
from statistics import fmean

import torch
from torch import Tensor


def mse(img1: Tensor, img2: Tensor) -> Tensor:
    """Mean squared difference of each entry of the first axis: (B, ...) and (B, ...) to (B, 1).

    An image (3, H, W) without a batch axis counts as three entries, one per channel.
    """
    return ((img1 - img2) ** 2).reshape(img1.shape[0], -1).mean(1, keepdim=True)


def psnr(img1: Tensor, img2: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for values in [0, 1], one per entry of the first axis: (B, ...) to (B, 1)."""
    return -10.0 * mse(img1, img2).log10()


def mean_psnr(values: Iterable[float | None]) -> float | None:
    """Mean of PSNRs in dB without those of equal images, which are infinite or None; None if no other is left."""
    finite = [value for value in values if value is not None and not math.isinf(value)]
    return fmean(finite) if finite else None


def as_float(image: Tensor) -> Tensor:
    """Image with uint8 pixels as float32 in [0, 1]; a float image unchanged."""
    return image.to(torch.float32) / 255.0 if image.dtype == torch.uint8 else image


def pixels_that_count(image: Tensor, mask: Tensor | None) -> Tensor:
    """Pixels (C, n) of an image (C, H, W) where the mask (1, H, W) is True; the image itself without a mask.

    If the mask is nowhere True, the result is one black pixel, so that two such images are equal.
    """
    if mask is None:
        return image
    return image[:, mask[0]] if mask.any() else image.new_zeros(image.shape[0], 1)


def half(width: int, of_test_view: bool) -> slice:
    """Columns of the half that counts where test photos train, too: the right one of their views, else the left one."""
    return slice(width // 2, width) if of_test_view else slice(0, width // 2)
