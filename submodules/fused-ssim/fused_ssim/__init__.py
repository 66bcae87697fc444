"""Structural similarity (SSIM) and mean absolute difference of two images, with their gradient, in one pass.

`composite` puts an image with alpha on a background, before the loss compares it with a render.
"""

import fused_ssim.backend  # noqa: F401  (first, because it says whether torch is missing)
from fused_ssim.bands import BAND_ROWS, REACH, photometric_loss_by_bands
from fused_ssim.maps import FusedSSIMMap
from fused_ssim.ops import PADDINGS, composite, fused_l1_ssim, fused_photometric_loss, fused_ssim, has_backend

allowed_padding = list(PADDINGS)  # a name of the reference

__all__ = [
    "BAND_ROWS",
    "REACH",
    "FusedSSIMMap",
    "allowed_padding",
    "composite",
    "fused_l1_ssim",
    "fused_photometric_loss",
    "fused_ssim",
    "has_backend",
    "photometric_loss_by_bands",
]
