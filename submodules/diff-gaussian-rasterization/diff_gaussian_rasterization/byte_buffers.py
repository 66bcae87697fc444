"""Tensors of several types in one tensor of bytes, as the reference hands the state of a rendering around."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor


def packed(*tensors: Tensor) -> Tensor:
    """Copies tensors into one of bytes, (B,) uint8."""
    return torch.cat([values.contiguous().reshape(-1).view(torch.uint8) for values in tensors])


def unpacked(buffer: Tensor, parts: Iterable[tuple[torch.dtype, tuple[int, ...]]]) -> list[Tensor]:
    """Copies the tensors of `packed` out again, given their dtypes and shapes.

    Raises ValueError if the buffer has another size.
    """
    parts = list(parts)
    sizes = [math.prod(shape) * dtype.itemsize for dtype, shape in parts]
    if buffer.dtype != torch.uint8 or buffer.shape != (sum(sizes),):
        found = f"{tuple(buffer.shape)} {buffer.dtype}"
        raise ValueError(f"the buffer must be the one of this rendering, ({sum(sizes)},) uint8, got {found}")
    pieces = zip(buffer.split(sizes), parts, strict=True)
    # In memory of their own, since kernels may want more alignment than a place within the buffer has.
    return [piece.clone().view(dtype).reshape(shape) for piece, (dtype, shape) in pieces]
