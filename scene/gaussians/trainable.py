"""Tensors made fit for an optimiser."""

from torch import Tensor, nn


def trainable(values: Tensor) -> Tensor:
    """The same parameter with contiguous values, as the fused kernels need them; a new one if none was given.

    Parameters, and leaves that want a gradient, stay the same objects. Other tensors are detached.
    """
    if not isinstance(values, nn.Parameter) and not (values.is_leaf and values.requires_grad):
        values = nn.Parameter(values.detach())
    if not values.is_contiguous():
        values.data = values.data.contiguous()
    return values
