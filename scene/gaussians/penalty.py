"""A penalty on opacities and scales: a part of the loss whose gradients the optimiser's step adds itself."""

from typing import NamedTuple

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.density import penalise_

from scene.gaussians.parameters import GaussianParameters


class Penalty(NamedTuple):
    """Weights of the mean opacity and of the mean scale (world units) of all Gaussians in the loss."""

    opacity: float = 0.0
    scale: float = 0.0

    def per_value(self, count: int) -> "Penalty":
        """The weights of a single opacity and of a single one of the three scales, among `count` Gaussians."""
        return Penalty(self.opacity / max(count, 1), self.scale / max(3 * count, 1))


NO_PENALTY = Penalty()


def add_penalty_gradients(gaussians: GaussianParameters, penalty: Penalty) -> None:
    """Add the gradients of a penalty to `.grad` of opacities and scales.

    The sums have the same bits as those of a fused step, which adds the penalty itself.
    """
    if not gaussians.kernels_activate:
        total = gaussians.gaussian_count
        opacity, scale = gaussians.get_opacity.sum() / total, gaussians.get_scaling.sum() / (3 * total)
        return (penalty.opacity * opacity + penalty.scale * scale).backward()
    params = gaussians._opacity, gaussians._scaling
    for param in params:
        if param.grad is None:
            param.grad = torch.zeros_like(param)
    each = penalty.per_value(gaussians.gaussian_count)
    gradients = [param.grad.contiguous() for param in params]
    penalise_(*(param.detach() for param in params), *gradients, opacity=each.opacity, scale=each.scale)
    for param, gradient in zip(params, gradients, strict=True):
        param.grad = gradient
