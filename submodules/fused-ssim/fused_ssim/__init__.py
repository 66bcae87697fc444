"""Structural similarity (SSIM) and mean absolute difference of two images, with their gradient, in one pass.

And `composite`, for photos with alpha that the loss is to compare with.
"""

from fused_ssim.ops import composite, fused_l1_ssim, fused_photometric_loss, fused_ssim

__all__ = ["composite", "fused_l1_ssim", "fused_photometric_loss", "fused_ssim"]
