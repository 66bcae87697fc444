"""Tensors of several types in one tensor of bytes, as the reference hands the state of a rendering around."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor


def packed(*tensors: Tensor) -> Tensor:
    """Copies tensors into one of bytes, (B,) uint8. Those with wider values come first, so that all stay aligned."""
    return torch.cat([values.contiguous().reshape(-1).view(torch.uint8) for values in tensors])


def unpacked(buffer: Tensor, parts: Iterable[tuple[torch.dtype, tuple[int, ...]]]) -> list[Tensor]:
    """Reads the tensors of `packed`, given their dtypes and shapes. They share the buffer's memory.

    Raises ValueError if the buffer has another size.
    """
    parts = list(parts)
    sizes = [math.prod(shape) * dtype.itemsize for dtype, shape in parts]
    if buffer.dtype != torch.uint8 or buffer.shape != (sum(sizes),):
        found = f"{tuple(buffer.shape)} {buffer.dtype}"
        raise ValueError(f"the buffer must be the one of this rendering, ({sum(sizes)},) uint8, got {found}")
    pieces = zip(buffer.split(sizes), parts, strict=True)
    return [piece.view(dtype).reshape(shape) for piece, (dtype, shape) in pieces]
