"""Losses between a render and its target: plain PyTorch for reading and comparing, fused kernels for training."""

import torch
import torch.nn.functional as F
from fused_ssim import fused_l1_ssim, fused_photometric_loss
from torch import Tensor

WINDOW = 11
SIGMA = 1.5  # pixels
C1 = 0.01**2
C2 = 0.03**2


def l1_loss(network_output: Tensor, gt: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (network_output - gt).abs().mean()


def l2_loss(network_output: Tensor, gt: Tensor) -> Tensor:
    """Mean squared difference."""
    return ((network_output - gt) ** 2).mean()


def _gaussian_window(size: int, like: Tensor) -> Tensor:
    """Normalised 1D Gaussian of `size` taps, sigma 1.5."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    weights = torch.exp(-0.5 * (x / SIGMA) ** 2)
    return (weights / weights.sum()).to(like)


def ssim(img1: Tensor, img2: Tensor, window_size: int = WINDOW, size_average: bool = True) -> Tensor:
    """Structural similarity (Wang et al. 2004, eq. 13) per channel, with a Gaussian window and zeros outside the image.

    img1, img2: (C, H, W) or (B, C, H, W) in [0, 1]. Returns the mean over everything, or over each image of the batch
    if `size_average` is off.
    """
    if img1.dim() == 3:
        img1, img2 = img1[None], img2[None]
    channels = img1.shape[1]
    window = _gaussian_window(window_size, img1)
    rows = window.view(1, 1, -1, 1).repeat(channels, 1, 1, 1)
    columns = window.view(1, 1, 1, -1).repeat(channels, 1, 1, 1)

    def blur(image: Tensor) -> Tensor:
        image = F.conv2d(image, rows, padding=(window_size // 2, 0), groups=channels)
        return F.conv2d(image, columns, padding=(0, window_size // 2), groups=channels)

    mean1, mean2 = blur(img1), blur(img2)
    variance1 = blur(img1 * img1) - mean1 * mean1
    variance2 = blur(img2 * img2) - mean2 * mean2
    covariance = blur(img1 * img2) - mean1 * mean2
    luminance = (2 * mean1 * mean2 + C1) / (mean1 * mean1 + mean2 * mean2 + C1)
    structure = (2 * covariance + C2) / (variance1 + variance2 + C2)
    similarity = luminance * structure
    return similarity.mean() if size_average else similarity.mean(dim=(1, 2, 3))


def photometric_loss(
    image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None, columns: slice | None = None
) -> tuple[Tensor, Tensor]:
    """Loss (1 - lambda) L1 + lambda (1 - SSIM) (Kerbl et al. 2023, eq. 7), and its L1 part for the log.

    Arguments as for `l1_and_ssim`, except that the image is clamped to [0, 1], so that values outside get no gradient.
    columns: the columns that count, None: all. The others are cut off; each pixel keeps its weight in the whole image.
    """
    if columns is not None:
        cut = [None if x is None else x[..., columns].contiguous() for x in (image, target, mask)]
        loss, l1 = photometric_loss(cut[0], cut[1], lambda_dssim, cut[2])
        share = len(range(image.shape[-1])[columns]) / image.shape[-1]
        return share * loss, l1
    if mask is None:
        return fused_photometric_loss(image, target, lambda_dssim)
    l1, similarity = l1_and_ssim(image.clamp(0, 1), target, mask)
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similarity), l1


def l1_and_ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Mean |image - target| and mean SSIM from one fused pass.

    image: (3, H, W) float32 in [0, 1], differentiable; target: the same shape, float32, or uint8 meaning value / 255.
    mask: (1, H, W) bool, the pixels that count. The others are treated like the zero padding outside the image, in both
    images. The sums of |difference| and of 1 - SSIM are divided by the number of pixels that count.
    """
    if mask is None:
        return fused_l1_ssim(image, target)
    l1, similarity = fused_l1_ssim(*(torch.where(mask, x, torch.zeros_like(x)) for x in (image, target)))
    share = mask.numel() / mask.sum().clamp_min(1)  # without a counting pixel both images are equal
    return share * l1, 1.0 - share * (1.0 - similarity)


def inverse_depth_loss(
    inverse_depth: Tensor, target: Tensor, columns: slice | None = None, mask: Tensor | None = None
) -> Tensor:
    """Mean absolute difference of inverse depths (1, H, W), 1 / world units.

    columns: the columns that count, None: all; in the others the difference is 0. mask: (1, H, W) bool, the pixels that
    count; the mean is over these, within the columns, as in photometric_loss.
    """
    difference = (inverse_depth - target).abs()
    pixels = difference.numel()
    if columns is not None:
        difference, mask = difference[..., columns], None if mask is None else mask[..., columns]
    if mask is None:
        return difference.mean() if columns is None else difference.sum() / pixels
    share = difference.numel() / pixels
    return share * torch.where(mask, difference, 0.0).sum() / mask.sum().clamp_min(1)
