"""Losses between a render and its target, by fused kernels where possible, else in plain PyTorch."""

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
import torch.nn.functional as F
from fused_ssim import FusedSSIMMap, fused_l1_ssim, fused_photometric_loss, has_backend
from fused_ssim.maps import gaussian_taps, separable_blur, similarity
from torch import Tensor

__all__ = [
    "FusedSSIMMap",
    "create_window",
    "fast_ssim",
    "gaussian",
    "inverse_depth_loss",
    "l1_and_ssim",
    "l1_loss",
    "l2_loss",
    "photometric_loss",
    "ssim",
]

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


def ssim(img1: Tensor, img2: Tensor, window_size: int = WINDOW, size_average: bool = True) -> Tensor:
    """Structural similarity (Wang et al. 2004, eq. 13) per channel, with a Gaussian window and zeros outside the image.

    img1, img2: (C, H, W) or (B, C, H, W) in [0, 1]. Returns the mean over everything, or over each image of the batch
    if `size_average` is off. Fused kernels compute it for a window of 11 pixels, unless both images need gradients;
    their gradient cannot be differentiated again.
    """
    img1, img2 = (image[None] if image.dim() == 3 else image for image in (img1, img2))
    if window_size != WINDOW or not _kernels_fit(img1, img2):
        blur = separable_blur(gaussian_taps(window_size, SIGMA), img1)
        return _take_mean(similarity(img1, img2, blur, C1, C2), size_average)
    if img2.requires_grad:
        img1, img2 = img2, img1  # SSIM is symmetric, and the kernels differentiate it by their first image
    if size_average:
        return fused_l1_ssim(img1, img2)[1]
    return torch.stack([fused_l1_ssim(*pair)[1] for pair in zip(img1, img2, strict=True)])


def _kernels_fit(img1: Tensor, img2: Tensor) -> bool:
    """Tell whether the fused kernels give the value and all gradients of the plain formula."""
    both = torch.is_grad_enabled() and img1.requires_grad and img2.requires_grad
    if both or torch._C._are_functorch_transforms_active():
        return False
    dtypes = (torch.float32, torch.float64) if img1.device.type == "cpu" else (torch.float32,)
    alike = img1.shape == img2.shape and img1.dtype == img2.dtype and img1.device == img2.device
    return alike and img1.dtype in dtypes and img1.numel() > 0 and has_backend(img1.device.type)


def _take_mean(similarities: Tensor, size_average: bool) -> Tensor:
    return similarities.mean() if size_average else similarities.mean(dim=(1, 2, 3))


def fast_ssim(img1: Tensor, img2: Tensor) -> Tensor:
    """Mean of `ssim` over two images of one shape (..., H, W); only img1 receives a gradient."""
    return fused_l1_ssim(img1, img2)[1]


def gaussian(window_size: int, sigma: float) -> Tensor:
    """Normalised Gaussian (window_size,) float32; sigma in pixels."""
    return gaussian_taps(window_size, sigma).float()


def create_window(window_size: int, channel: int) -> Tensor:
    """Normalised Gaussian windows (channel, 1, window_size, window_size) float32, sigma 1.5, for `_ssim`."""
    taps = gaussian_taps(window_size, SIGMA)
    return torch.outer(taps, taps).float().repeat(channel, 1, 1, 1)


def _ssim(
    img1: Tensor, img2: Tensor, window: Tensor, window_size: int, channel: int, size_average: bool = True
) -> Tensor:
    """Do as `ssim` with the caller's windows (`create_window`)."""

    def blur(image: Tensor) -> Tensor:
        return F.conv2d(image, window, padding=window_size // 2, groups=channel)

    return _take_mean(similarity(img1, img2, blur, C1, C2), size_average)


def photometric_loss(
    image: Tensor,
    target: Tensor,
    lambda_dssim: float,
    mask: Tensor | None = None,
    columns: slice | None = None,
    clamp: bool = True,
) -> tuple[Tensor, Tensor]:
    """Loss (1 - lambda) L1 + lambda (1 - SSIM) (Kerbl et al. 2023, eq. 7), and its L1 part for the log.

    Arguments as for `l1_and_ssim`. clamp: clamp the image to [0, 1] first, so that values outside get no gradient.
    columns: the columns that count, None: all. The others are cut off; each pixel keeps its weight in the whole image.
    """
    if columns is not None:
        cut = [None if x is None else x[..., columns].contiguous() for x in (image, target, mask)]
        loss, l1 = photometric_loss(cut[0], cut[1], lambda_dssim, cut[2], clamp=clamp)
        share = len(range(image.shape[-1])[columns]) / image.shape[-1]
        return share * loss, l1
    if mask is None:
        return fused_photometric_loss(image, target, lambda_dssim, clamp)
    l1, similarity = l1_and_ssim(image.clamp(0, 1) if clamp else image, target, mask)
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
