"""A decorator for backwards that have no derivative themselves."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def first_order(backward: Callable[..., tuple]) -> Callable[..., tuple]:
    """Lets second derivatives raise RuntimeError, always.

    torch's once_differentiable does so only where the incoming gradients need a derivative themselves. Where they are
    constant, as for a sum, it returns constants, and a penalty on the gradient would add nothing.
    """
    once = once_differentiable(backward)

    @functools.wraps(backward)
    def wrapper(ctx: Any, *gradients: Tensor | None) -> tuple:
        if not torch.is_grad_enabled():
            return backward(ctx, *gradients)  # there will be no second derivative
        # Transforms of torch.func ask for a graph in every first derivative, so there the rule of torch stays.
        if not torch._C._are_functorch_transforms_active():
            gradients = [None if values is None else values.detach().requires_grad_() for values in gradients]
        return once(ctx, *gradients)

    return wrapper
