"""Gradients that wait for an optimiser step of a later iteration, as a checkpoint keeps them."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

HELD = "held"  # key in the optimiser's state dict


def held_state(seen: Tensor, params: Mapping[str, Tensor]) -> dict[str, Any]:
    """What waits, as tensors. seen: (N,) bool, the Gaussians seen since the last step; params: by name."""
    gradients = {name: param.grad for name, param in params.items() if param.grad is not None}
    return {HELD: {"seen": seen, "gradients": gradients}}


def take_held(state: Any, params: Mapping[str, Tensor], count: int) -> Tensor:
    """Give the parameters the gradients of `held_state`; return its `seen` for `count` Gaussians.

    ValueError that says what does not fit.
    """
    try:
        seen, gradients = state["seen"], dict(state["gradients"])
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError("its held gradients are incomplete") from error
    if not torch.is_tensor(seen) or seen.dtype != torch.bool or seen.shape != (count,):
        raise ValueError("its held gradients are of another number of Gaussians")
    for name, gradient in gradients.items():
        param = params.get(name)
        fits = param is not None and torch.is_tensor(gradient) and gradient.shape == param.shape
        if not fits or gradient.dtype != param.dtype or not gradient.isfinite().all():
            raise ValueError(f"the held gradient of {name} does not fit, or is not finite")
        param.grad = gradient.detach().to(param.device)
    return seen.to(next(iter(params.values())).device)
