"""Functions that give the same bits on every CPU, with any number of threads.

torch's functions differ in their last bits between vector body and scalar tail, so also between numbers of threads, and
between devices. In torch for x86, exp, log, square root and products of matrices are MKL's, which takes other code on a
processor by Intel than on one by AMD. Values that enter the model must not differ. `exp` and `log` use operations that
IEEE 754 rounds in one way only (csrc/math/portable.h), on a GPU too, and have no derivatives.
"""

from collections.abc import Callable
from typing import Any

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor


def exp(x: Tensor) -> Tensor:
    """e^x in float64 to a few units in the last place, |x| <= 700 (clamped). `x`: any floating type. No derivative."""
    return OPERATORS.exp(x.to(torch.float64))


def log(x: Tensor) -> Tensor:
    """Natural logarithm of positive finite float64 numbers, to 1e-15 relative to max(1, |result|). No derivative."""
    return OPERATORS.log(x)


def exponential(x: Tensor) -> Tensor:
    """e^x in the type of `x`, differentiable. Bits on a GPU differ from a CPU's."""
    return _Differentiable.apply(x, lambda x: torch.exp(x) if x.is_cuda else exp(x).to(x.dtype), torch.mul)


def square_root(x: Tensor) -> Tensor:
    """The correctly rounded square root of float32 numbers, differentiable; on a GPU, too.

    No such root is nearer than 4 units of float64 to the middle of two float32 numbers, and MKL errs by less than one.
    """
    return _Differentiable.apply(x, lambda x: x.double().sqrt().to(x.dtype), lambda g, y: g / (2 * y))


class _Differentiable(torch.autograd.Function):
    """Apply function(x) = y; its backward is slope(g, y), the gradient g of y times the derivative."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, function: Callable[[Tensor], Tensor], slope: Callable[..., Tensor]) -> Tensor:
        y = function(x)
        ctx.slope = slope
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.slope(gradient, *ctx.saved_tensors), None, None
