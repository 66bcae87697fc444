"""Structural similarity (SSIM) and mean absolute difference of two images, with their gradient, in one pass."""

from fused_ssim.ops import fused_l1_ssim, fused_photometric_loss, fused_ssim

__all__ = ["fused_l1_ssim", "fused_photometric_loss", "fused_ssim"]
