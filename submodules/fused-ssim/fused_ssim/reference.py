"""The oracle: SSIM by its definition, window by window, in float64; autograd differentiates it."""

import torch
import torch.nn.functional as F
from torch import Tensor


def ssim_map(img1: Tensor, img2: Tensor) -> Tensor:
    """SSIM at each pixel of two images (..., H, W) in [0, 1] or uint8, which are zero beyond the border: float64.

    Follows Wang, Bovik, Sheikh and Simoncelli 2004, eq. 13 to 16, with an 11 x 11 Gaussian window of sigma 1.5.
    Variances are means of squared deviations, as in the paper: E[x²] - mu² would lose digits. Memory: 121 numbers for
    each pixel of each image.
    """
    taps = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps).reshape(121, 1) / taps.sum() ** 2

    def windows(image: Tensor) -> Tensor:
        values = image.double() / 255 if image.dtype == torch.uint8 else image.double()
        return F.unfold(values.reshape(-1, 1, *image.shape[-2:]), 11, padding=5)  # (planes, 121, H * W)

    def mean(z: Tensor) -> Tensor:
        return (window * z).sum(1, keepdim=True)

    x, y = windows(img1), windows(img2)
    mu1, mu2 = mean(x), mean(y)
    var1, var2, cov = mean((x - mu1) ** 2), mean((y - mu2) ** 2), mean((x - mu1) * (y - mu2))
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mu1 * mu2 + c1) / (mu1**2 + mu2**2 + c1)
    structure = (2 * cov + c2) / (var1 + var2 + c2)
    return (luminance * structure).reshape(img1.shape)


def l1_ssim(img1: Tensor, img2: Tensor, padding: str = "same") -> tuple[Tensor, Tensor]:
    """Mean |img1 - img2| and mean SSIM, by the definition that `fused_ssim.fused_l1_ssim` is held to; float64."""
    full = ssim_map(img1, img2)
    if img2.dtype == torch.uint8:
        img2 = img2.double() / 255
    l1 = (img1.double() - img2.double()).abs().mean()
    return l1, (full if padding == "same" else full[..., 5:-5, 5:-5]).mean()
