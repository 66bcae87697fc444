"""Where the rows of a model lie: on the device that computes, or a part of them on the host (`Room`).

A spilled tensor is one of a GPU, with its first rows in its memory and the others in the host's. Both lie in one range
of addresses, so kernels and copies take such a tensor for any other (csrc/torch/spilled.cpp of the rasterizer). On the
CPU there are none.
"""

from typing import Any

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from groundwork.ranks.rows import PIECE


class Room:
    """What the slot `model.room` provides: all rows stay on the device. A part may divide them between it and the host.

    limit: bytes of the device that all which is trained may take; 0: all.
    """

    limit = 0

    def expect(self, count: int, scene: Any) -> None:
        """Take note of a number of this process's Gaussians that will come. scene: whose photos take memory, too."""

    def empty_rows(self, like: Tensor, rows: int) -> Tensor | None:
        """An uninitialised tensor for so many rows of f_rest; None: wherever torch puts it."""
        return None

    def host_bytes(self, count: int) -> int:
        """Bytes of so many Gaussians that lie on the host instead of the device."""
        return 0

    def remedy(self, count: int, lacking: float) -> str:
        """What to do where so many Gaussians lack so many bytes: the beginning of a sentence, or nothing."""
        return ""


def empty_for(model: Any, name: str | None, like: Tensor, rows: int) -> Tensor | None:
    """An uninitialised tensor for so many rows of a model's attribute; None: wherever torch puts it.

    like: (..., *shape of a row) on the device that computes. The model's `room` decides, if it has one.
    """
    room = getattr(model, "room", None)
    return room.empty_rows(like, rows) if room is not None and name == "f_rest" else None


def placed(model: Any, name: str | None, values: Tensor) -> Tensor:
    """Values of an attribute where the model keeps them: a copy, unless they lie there."""
    room = None if is_spilled(values) else empty_for(model, name, values, len(values))
    return values if room is None else room.copy_(values)


def empty_rows(like: Tensor, rows: int, near: int) -> Tensor | None:
    """An uninitialised tensor of so many rows like those of `like`, its first `near` bytes on the GPU, by whole pages.

    None on the CPU.
    """
    try:
        return OPERATORS.spilled(like, rows, near)
    except torch.OutOfMemoryError:
        torch.cuda.empty_cache()  # torch may keep for later what the driver lacks
        return OPERATORS.spilled(like, rows, near)


def bytes_of(values: Tensor | None = None) -> tuple[int, int]:
    """Bytes of a spilled tensor on the GPU and on the host, 0 and 0 of another one; None: of all that live."""
    near, far = OPERATORS.spilled_bytes(values).tolist()
    return near, far


def is_spilled(values: Tensor) -> bool:
    """Whether a part of a tensor may lie in the host's memory though it is one of a GPU."""
    return values.dtype in (torch.float32, torch.float64) and any(bytes_of(values))


def empty_spilled_as(old: Tensor) -> Tensor | None:
    """An uninitialised tensor that is spilled as another one is; None if that is not."""
    return empty_rows(old, len(old), bytes_of(old)[0]) if is_spilled(old) else None


def spilled_as(old: Tensor, new: Tensor) -> Tensor:
    """Values that belong to others of the same shape: a copy that is spilled as these are, else the same tensor."""
    room = empty_spilled_as(old)
    return new if room is None else room.copy_(new)


def zeros_spilled_as(old: Tensor) -> Tensor:
    """Zeros like a tensor, spilled as that is."""
    room = empty_spilled_as(old)
    return torch.zeros_like(old) if room is None else room.zero_()


def to_host(values: Tensor, keep: Tensor | slice) -> Tensor:
    """values[keep] on the host, for a mask (N,) bool, indices or a slice; by pieces that the GPU has room for."""
    rows = torch.arange(len(values), device=values.device)[keep]
    kept = torch.empty(len(rows), *values.shape[1:], dtype=values.dtype)
    for start in range(0, len(rows), PIECE):
        kept[start : start + PIECE] = values[rows[start : start + PIECE]]
    return kept
