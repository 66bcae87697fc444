"""Structural similarity (SSIM) and mean absolute difference of two images, with their gradient, in one pass.

`composite` puts an image with alpha on a background, before the loss compares it with a render.
"""

from fused_ssim.ops import composite, fused_l1_ssim, fused_photometric_loss, fused_ssim

__all__ = ["composite", "fused_l1_ssim", "fused_photometric_loss", "fused_ssim"]
