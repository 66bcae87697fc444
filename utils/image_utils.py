"""Scores of image pairs as the training report gives them. metrics.py has its own (8-bit files, one MSE per image)."""

import torch
from torch import Tensor


def mse(img1: Tensor, img2: Tensor) -> Tensor:
    """Mean squared difference of each entry of the first axis: (B, ...) twice -> (B, 1).

    An image given as (3, H, W) without a batch axis is taken as three entries, one per channel.
    """
    return ((img1 - img2) ** 2).reshape(img1.shape[0], -1).mean(1, keepdim=True)


def psnr(img1: Tensor, img2: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for values in [0, 1], one per entry of the first axis: (B, ...) -> (B, 1)."""
    return -10.0 * mse(img1, img2).log10()


def right_half(image: Tensor) -> Tensor:
    """The columns from W // 2 on of an image (..., W): what the half-image protocol scores (scene/half_images.py)."""
    return image[..., image.shape[-1] // 2 :]


def as_float(image: Tensor) -> Tensor:
    """uint8 pixels as float32 in [0, 1]; float ones as they are."""
    return image.to(torch.float32) / 255.0 if image.dtype == torch.uint8 else image


def pixels_that_count(image: Tensor, mask: Tensor | None) -> Tensor:
    """The pixels (C, n) of an image (C, H, W) where the mask (1, H, W) is True; the image itself without a mask.

    Where the mask is nowhere True this is one black pixel, so that two such images are equal.
    """
    if mask is None:
        return image
    return image[:, mask[0]] if mask.any() else image.new_zeros(image.shape[0], 1)
