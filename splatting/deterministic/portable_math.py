"""exp and log in float64 from operations that IEEE 754 rounds in one way only (csrc/math/portable.h).

torch's functions differ in their last bits between vector body and scalar tail, so also between numbers of threads, and
between devices. Values that enter the model, the positions of split Gaussians, must not differ.
"""

import splatting.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor


def exp(x: Tensor) -> Tensor:
    """e^x in float64 to a few units in the last place, |x| <= 700 (clamped). `x` of any floating type."""
    return OPERATORS.exp(x.to(torch.float64))


def log(x: Tensor) -> Tensor:
    """Natural logarithm of positive finite float64 numbers, to 1e-15 relative to max(1, |result|)."""
    return OPERATORS.log(x)
