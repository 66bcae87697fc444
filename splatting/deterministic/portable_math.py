"""Functions from operations that IEEE 754 rounds in one way only (csrc/math/portable.h).

torch's functions differ in their last bits between vector body and scalar tail, so also between numbers of threads, and
between devices. On a CPU torch's exp, log, square root and products of matrices are MKL's, which takes other code on a
processor by Intel than on one by AMD. Values that enter the model must not differ.
"""

from collections.abc import Callable
from typing import Any

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


def exponential(x: Tensor) -> Tensor:
    """e^x in the type of `x`, differentiable. The same bits on all CPUs; a GPU has its own."""
    return _Differentiable.apply(x, lambda x: torch.exp(x) if x.is_cuda else exp(x).to(x.dtype), torch.mul)


def root(x: Tensor) -> Tensor:
    """The square root of float32 numbers, differentiable.

    It is rounded rightly on every device, as float64 has more than twice the digits (Figueroa 1995, When is double
    rounding innocuous?), and MKL's error there is below a unit in the last place.
    """
    return _Differentiable.apply(x, lambda x: x.double().sqrt().to(x.dtype), lambda g, y: g / (2 * y))


class _Differentiable(torch.autograd.Function):
    """function(x) = y, and slope(g, y): the gradient g of y times the derivative."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, function: Callable[[Tensor], Tensor], slope: Callable[..., Tensor]) -> Tensor:
        y = function(x)
        ctx.slope = slope
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.slope(gradient, *ctx.saved_tensors), None, None
