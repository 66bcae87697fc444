"""Storage of a model's rows: on the device that computes, or partly on the host (`Storage`).

A spilled tensor is a GPU's tensor, with its first rows in the GPU's memory and the others in the host's. Both lie in
one range of addresses, so kernels and copies treat such a tensor like any other (csrc/torch/spilled.cpp of the
rasterizer). On the CPU there are none.
"""

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from groundwork.ranks.rows import PIECE


class Storage:
    """Storage of a model whose rows may lie partly on the host: `model.storage`, which is None if none may."""

    def empty_rows(self, like: Tensor, rows: int) -> Tensor | None:
        """Make an uninitialised tensor for `rows` rows of f_rest; None: torch decides its place."""
        raise NotImplementedError

    def empty_for(self, name: str | None, like: Tensor, rows: int) -> Tensor | None:
        """Make an uninitialised tensor for `rows` rows of an attribute; None: torch decides its place.

        like: (..., *shape of a row) on the device that computes.
        """
        return self.empty_rows(like, rows) if name == "f_rest" else None

    def put(self, name: str | None, values: Tensor) -> Tensor:
        """Put values of an attribute where they are kept: return a copy, or the values if they are there."""
        room = None if is_spilled(values) else self.empty_for(name, values, len(values))
        return values if room is None else room.copy_(values)


def empty_rows(like: Tensor, rows: int, near: int) -> Tensor | None:
    """Make an uninitialised tensor of `rows` rows like `like`'s, its first `near` bytes on the GPU, in whole pages.

    None on the CPU.
    """
    try:
        return OPERATORS.spilled(like, rows, near)
    except torch.OutOfMemoryError:
        torch.cuda.empty_cache()  # torch may keep for later what the driver lacks
        return OPERATORS.spilled(like, rows, near)


def bytes_of(values: Tensor | None = None) -> tuple[int, int]:
    """Bytes of a spilled tensor on the GPU and on the host, 0 and 0 if it is not spilled; None: of all tensors."""
    near, far = OPERATORS.spilled_bytes(values).tolist()
    return near, far


def is_spilled(values: Tensor) -> bool:
    """Tell whether a part of a GPU's tensor may lie in the host's memory."""
    return values.dtype in (torch.float32, torch.float64) and any(bytes_of(values))


def empty_spilled_as(old: Tensor) -> Tensor | None:
    """Make an uninitialised tensor that is spilled as `old` is; None if `old` is not."""
    return empty_rows(old, len(old), bytes_of(old)[0]) if is_spilled(old) else None


def spilled_as(old: Tensor, new: Tensor) -> Tensor:
    """Copy `new` into a tensor that is spilled as `old`, of the same shape; return `new` if `old` is not spilled."""
    room = empty_spilled_as(old)
    return new if room is None else room.copy_(new)


def zeros_spilled_as(old: Tensor) -> Tensor:
    """Make zeros like a tensor, spilled as it is."""
    room = empty_spilled_as(old)
    return torch.zeros_like(old) if room is None else room.zero_()


def to_host(values: Tensor, keep: Tensor | slice) -> Tensor:
    """Copy values[keep] to the host, for a mask (N,) bool, indices or a slice; in pieces that fit on the GPU."""
    rows = torch.arange(len(values), device=values.device)[keep]
    kept = torch.empty(len(rows), *values.shape[1:], dtype=values.dtype)
    for start in range(0, len(rows), PIECE):
        kept[start : start + PIECE] = values[rows[start : start + PIECE]]
    return kept
