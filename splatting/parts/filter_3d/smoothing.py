"""The 3D smoothing filter of Yu et al. 2024 (Mip-Splatting), section 4.1: no Gaussian is finer than the photos show.

A Gaussian's covariance is convolved with an isotropic one, whose variance is VARIANCE over the square of the highest
rate (pixels by unit of length) at which a training view samples it (equations 6 to 9); its opacity falls with the
square root of the determinant. Both are functions of the raw values that train. Values that enter the model are
computed in float64: on the CPU by functions whose bits do not depend on the number of threads.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from scene.gaussians.parameters import GaussianParameters
from scene.sampling_rate import sampling_rate
from splatting.deterministic import portable_math
from utils.system_utils import UserError

# In squared pixels. The paper's 0.2 goes with renders that add 0.1. Ours, and those of all viewers, add 0.3 already.
VARIANCE = 0.05

NAME = "filter_3d"  # of the column

Function = Callable[[Tensor], Tensor]


def filter_widths(points: Tensor, views: Sequence[Any], enlargement: float = 1.0) -> Tensor:
    """Standard deviations (N, 1) of the filter at points (N, 3), in units of length; 0 where no view shows a point.

    enlargement: of the model where it is drawn.
    """
    rates = torch.zeros_like(points[:, 0])
    for view in views:
        rates = torch.maximum(rates, sampling_rate(points, view, enlargement))
    return torch.where(rates > 0, math.sqrt(VARIANCE) / rates, 0.0)[:, None]


def check_widths(widths: Any, count: int) -> None:
    """UserError for what a checkpoint has as its filter, if it does not fit so many Gaussians."""
    if not torch.is_tensor(widths) or widths.shape != (count, 1) or widths.dtype != torch.float32:
        raise UserError("the 3D filter of the checkpoint does not fit its Gaussians; give another one")


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


class Smoothing:
    """Raw opacities and scales of a model behind its filter: the slot `model.drawn`."""

    def __init__(self, model: GaussianParameters) -> None:
        """The widths (N, 1) of the filter are the model's column of this name."""
        self._model = model

    def __call__(self, logits: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
        return filtered(logits, log_scales, self._model.columns[NAME])

    chain = staticmethod(chain_of)
