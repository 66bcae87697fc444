"""Gaussians behind a 3D filter (Mip-Splatting, Yu et al. 2024): wider by its variance, and fainter by as much.

The opacity falls with the square root of the covariance's determinant. Both are functions of the raw values that train.
They are computed in float64: on the CPU by functions whose bits do not depend on the number of threads.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from splatting.deterministic import portable_math

Function = Callable[[Tensor], Tensor]


def filtered(logits: Tensor, log_scales: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """Logits (N, 1) and log scales (N, 3) with the filter of `widths` (N, 1), differentiable by both."""
    return _Filtered.apply(logits, log_scales, widths)


def chain_of(logits: Tensor, log_scales: Tensor, found_logits: Tensor, found_scales: Tensor) -> Tensor:
    """Derivatives (N, 7) of what `filtered` has found, in the order of csrc/math/chain.h.

    Of the logit by the logit; of each log scale by itself; of the logit by each log scale.
    """
    exp, _ = _functions(logits)
    kept = exp(2 * (log_scales.double() - found_scales.double()))  # variance before, by that after
    steep = 1 + exp(found_logits.double())  # d logit / d ln opacity
    return torch.cat((steep / (1 + exp(logits.double())), kept, (1 - kept) * steep), 1).to(logits.dtype)


def _functions(values: Tensor) -> tuple[Function, Function]:
    return (torch.exp, torch.log) if values.is_cuda else (portable_math.exp, portable_math.log)


class _Filtered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, log_scales: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
        exp, log = _functions(logits)
        x, s, width = logits.double(), log_scales.double(), widths.double()
        wider = 0.5 * log(1 + width * width * exp(-2 * s))
        fainter = wider[:, :1] + wider[:, 1:2] + wider[:, 2:]  # -ln of sqrt(determinant before / after)
        # The new 1 / opacity - 1 is `rest` over exp(-fainter), and for x < 0 over e, too: no term overflows.
        e, positive = exp(-x.abs()), x > 0
        rest = torch.where(positive, e, 1.0) + torch.where(positive, 1.0, e) * (1 - exp(-fainter))
        found = (x.clamp_max(0) - fainter - log(rest)).to(logits.dtype), (s + wider).to(log_scales.dtype)
        ctx.save_for_backward(logits, log_scales, *found)
        return found

    @staticmethod
    def backward(ctx: Any, of_logits: Tensor, of_scales: Tensor) -> tuple[Tensor, Tensor, None]:
        chain = chain_of(*ctx.saved_tensors)
        # As chain_rule of csrc/math/chain.h, so that all kinds of steps have the same bits.
        return chain[:, :1] * of_logits, chain[:, 1:4] * of_scales + chain[:, 4:] * of_logits, None
