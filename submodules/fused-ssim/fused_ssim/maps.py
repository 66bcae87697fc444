"""SSIM at every pixel in plain PyTorch: any window, any float dtype, gradients of both images of any order."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from fused_ssim.ops import PADDINGS

Blur = Callable[[Tensor], Tensor]


def gaussian_taps(size: int, sigma: float) -> Tensor:
    """Normalised values of a Gaussian of `sigma` pixels at `size` pixels around its centre: (size,) float64."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    weights = torch.exp(-0.5 * (x / sigma) ** 2)
    return weights / weights.sum()


def separable_blur(taps: Tensor, image: Tensor) -> Blur:
    """Makes the blur of images like `image` (B, C, H, W), zero beyond the border, with a window of taps (n,)."""
    channels = image.shape[-3]
    down = taps.to(image).view(1, 1, -1, 1).expand(channels, 1, -1, 1)
    across = taps.to(image).view(1, 1, 1, -1).expand(channels, 1, 1, -1)
    half = len(taps) // 2

    def blur(values: Tensor) -> Tensor:
        values = F.conv2d(values, down, padding=(half, 0), groups=channels)
        return F.conv2d(values, across, padding=(0, half), groups=channels)

    return blur


def similarity(img1: Tensor, img2: Tensor, blur: Blur, c1: float, c2: float) -> Tensor:
    """SSIM at each pixel (Wang et al. 2004, eq. 13) with the windows of `blur` and the constants c1 and c2."""
    mean1, mean2 = blur(img1), blur(img2)
    variance1 = blur(img1 * img1) - mean1 * mean1
    variance2 = blur(img2 * img2) - mean2 * mean2
    covariance = blur(img1 * img2) - mean1 * mean2
    luminance = (2 * mean1 * mean2 + c1) / (mean1 * mean1 + mean2 * mean2 + c1)
    structure = (2 * covariance + c2) / (variance1 + variance2 + c2)
    return luminance * structure


class FusedSSIMMap:
    """The map under the name by which older code calls it. `fused_ssim` is much faster where its mean is wanted."""

    @staticmethod
    def apply(C1: float, C2: float, img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
        """SSIM at each pixel of two images (B, C, H, W) in [0, 1], with a Gaussian window of 11 pixels, sigma 1.5.

        padding "valid" leaves out a rim of 5 pixels. Only img1 receives a gradient, and none with train=False.
        """
        if padding not in PADDINGS:
            raise ValueError(f'padding must be "same" or "valid", got {padding!r}')
        blur = separable_blur(gaussian_taps(11, 1.5), img1)
        values = similarity(img1 if train else img1.detach(), img2.detach(), blur, C1, C2)
        return values if padding == "same" else values[..., 5:-5, 5:-5]
