"""The limit of what a training takes of a GPU, and the SH bands above 0 that lie in the host's memory to keep it."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.spilled import bytes_of, empty_rows, is_spilled
from scene.images.store import ImageStore
from splatting.host.memory import free_memory, gib
from splatting.training.memory_estimate import near_rows, photo_bytes, spillable_bytes, training_bytes
from utils.system_utils import compute_device

_USABLE = 0.95  # of a GPU's free memory, where nobody has given a limit; torch cannot fill what it holds
_BUS = 40e9  # bytes a second that kernels read or write in the host's memory
_SLOW = 10.0  # milliseconds a step, from which on the bus is named
_PAGE = 2 << 20  # bytes; a spilled tensor has whole pages in each memory
_CAN_SPILL = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 11)  # csrc/torch/spilled.cpp
_SPARE = 0.03  # of a limit, what torch cannot fill of its blocks; and at least
_LEAST_SPARE = 1 << 27  # bytes, for the lists of the first step
_WHOLE_STEP = 20  # bytes of a Gaussian besides the estimate, in steps for which all blocks wake


@contextmanager
def own_limit() -> Iterator[None]:
    """Within it a training may limit torch; afterwards, torch may take what it might before."""
    before = torch.cuda.get_per_process_memory_fraction() if compute_device().type == "cuda" else 0
    try:
        yield
    finally:
        if before:
            torch.cuda.set_per_process_memory_fraction(before)


def limit_torch(limit: float, device: torch.device) -> None:
    """Leave torch so many bytes of the GPU; `free_memory` then counts no others.

    Its segments then grow and shrink, as lists that change their size would leave holes of a fifth of the limit.
    """
    if _CAN_SPILL:
        torch._C._accelerator_setAllocatorSettings("expandable_segments:True")
    if torch.cuda.memory_reserved(device) > limit:
        torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(max(limit / total, 0.0), 1.0))


class GpuMemory:
    """Decides how many rows of f_rest and its averages stay on the GPU; `spill` of the model, which it makes room for.

    While rows change, new tensors find the GPU's memory taken by the old ones. What lacks room lies on the host until
    `settle` brings it back. limit: bytes for torch and spilled tensors together, 0: no limit, so that nothing is
    spilled.
    """

    def __init__(
        self,
        limit: float,
        gaussians: GaussianModel,
        images: ImageStore,
        pixels: int,
        absolute: bool,
        device: torch.device,
    ) -> None:
        """Take a limit in GiB, 0 for none. pixels: of the largest view. absolute: with absolute gradients."""
        self.limit, self._device = int(limit * 2**30), device
        self._each = training_bytes(gaussians, 1, 0, absolute) + _WHOLE_STEP
        self._spillable = spillable_bytes(gaussians, 1)
        self._fixed = training_bytes(gaussians, 0, pixels) + photo_bytes(images, device)
        if self.limit and device.type == "cuda":  # other programs may have a part of what was given
            there = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
            self.limit = min(self.limit, int(_USABLE * there))
        gaussians.spill = self.room
        self._limit_torch(0)

    def expect(self, count: int) -> None:
        """Take note of a number of this process's Gaussians that will come: a limit begins where they do not fit."""
        if self.limit or self._device.type != "cuda" or not _CAN_SPILL:
            return
        limit = int(_USABLE * (free_memory(self._device) + torch.cuda.memory_allocated(self._device)))
        if self._needed(count, limit) > limit:
            self.limit = limit
            self._limit_torch(0)

    def room(self, like: Tensor, rows: int) -> Tensor | None:
        """An uninitialised tensor for so many rows of f_rest; None: all may stay on the GPU."""
        if not self._spills(rows):
            self._limit_torch(0)
            return None
        each = self._near_bytes(like, rows)
        size = max(min(each, 3 * each - bytes_of()[0]), 0) if is_spilled(like) else 0
        self._limit_torch(max(3 * each, bytes_of()[0] + size))
        return empty_rows(like, rows, size)

    def settle(self, gaussians: GaussianModel) -> None:
        """Bring rows to the GPU for which there is room, now that rows have changed."""
        if not self.limit or not self._spills(len(gaussians)):
            return
        rest = gaussians.raw("f_rest")
        state = gaussians.optimizer.state.get(rest, {})
        rest.data = self._settled(rest.data)
        for name in ("exp_avg", "exp_avg_sq"):
            if name in state:
                state[name] = self._settled(state[name])

    def _settled(self, values: Tensor) -> Tensor:
        wanted = self._near_bytes(values, len(values))
        if not is_spilled(values) or bytes_of(values)[0] > wanted - _PAGE:
            return values
        return empty_rows(values, len(values), wanted).copy_(values)

    def _near_bytes(self, like: Tensor, rows: int) -> int:
        """Bytes of so many rows of one tensor that may stay on the GPU."""
        return self.near_rows(rows) * math.prod(like.shape[1:]) * like.element_size()

    def _spills(self, count: int) -> bool:
        """Whether so many rows do not fit with all that a change of them needs."""
        return self.limit > 0 and self._needed(count, self.limit) > self.limit

    def _needed(self, count: int, limit: int) -> int:
        return self._fixed + max(int(_SPARE * limit), _LEAST_SPARE) + count * self._each

    def near_rows(self, count: int) -> int:
        """How many of so many rows stay on the GPU."""
        if not self._spills(count):
            return count
        # The estimate has room for the copy of one of three tensors while rows change, which here lies on the host.
        others = self._needed(count, self.limit) - count * self._spillable * 4 / 3
        return near_rows(self.limit, count, others, count * self._spillable)

    def spilled_bytes(self, count: int) -> int:
        """Bytes of so many Gaussians in the host's memory."""
        return self._spillable * (count - self.near_rows(count)) if self._device.type == "cuda" else 0

    def words(self, count: int, seen: float, same: bool) -> list[str]:
        """What to say before a training of so many Gaussians, if some of it is spilled.

        seen: the part of them that a step concerns. same: whether the files do not depend on that.
        """
        spilled = self.spilled_bytes(count)
        if not spilled:
            return []
        said = [
            f"{gib(spilled)} of {count:,} Gaussians go to the memory of the host, as all of them need more than "
            f"{gib(self.limit)} of the GPU; the files stay the same" + ("" if same else " up to rounding")
        ]
        milliseconds = 1e3 * 2 * spilled * seen / _BUS
        if milliseconds > _SLOW:
            said.append(
                f"the bus to that memory will set the pace: about {milliseconds:.0f} ms a step, which concerns "
                f"{seen:.0%} of the Gaussians"
            )
        return said

    def _limit_torch(self, near: int) -> None:
        """Leave torch the limit less so many bytes, or those that spilled tensors have now."""
        if self.limit and self._device.type == "cuda":
            limit_torch(self.limit - max(near, bytes_of()[0]), self._device)
