"""The 3D smoothing filter of Yu et al. 2024 (Mip-Splatting), section 4.1: no Gaussian is finer than the photos show.

A Gaussian's covariance is convolved with an isotropic one, whose variance is VARIANCE over the square of the highest
rate (pixels by unit of length) at which a training view samples it (equations 6 to 9).
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from scene.gaussians.filtered import chain_of, filtered
from scene.gaussians.parameters import GaussianParameters
from scene.sampling_rate import sampling_rate
from utils.system_utils import UserError

# In squared pixels. The paper's 0.2 goes with renders that add 0.1. Ours, and those of all viewers, add 0.3 already.
VARIANCE = 0.05

NAME = "filter_3d"  # of the column


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


class Smoothing:
    """Raw opacities and scales of a model behind its filter: the slot `model.drawn`."""

    def __init__(self, model: GaussianParameters) -> None:
        """The widths (N, 1) of the filter are the model's column of this name."""
        self._model = model

    def __call__(self, logits: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
        return filtered(logits, log_scales, self._model.columns[NAME])

    chain = staticmethod(chain_of)
