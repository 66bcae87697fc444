"""The limit of what a training takes of a GPU, and the SH bands above 0 that lie in the host's memory to keep it."""

import math
import os

import torch
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.spilled import bytes_of, empty_rows
from scene.images.store import ImageStore
from splatting.host.memory import free_memory, gib
from splatting.training.memory_estimate import near_rows, photo_bytes, spillable_bytes, training_bytes

_USABLE = 0.95  # of a GPU's free memory, where nobody has given a limit; torch cannot fill what it holds
_BUS = 40e9  # bytes a second that kernels read or write in the host's memory
_SLOW = 10.0  # milliseconds a step, from which on the bus is named
_MUCH = 0.25  # of a GPU's free memory


def reads_on_host(checkpoint: str | None, limit: float, device: torch.device) -> bool:
    """Whether a checkpoint is read into the host's memory first, as its rows may be spilled. limit: in GiB."""
    if limit or checkpoint is None or device.type != "cuda":
        return limit > 0
    return os.path.getsize(checkpoint) > _MUCH * free_memory(device)


def limit_torch(limit: float, device: torch.device) -> None:
    """Leave torch so many bytes of the GPU; `free_memory` then counts no others."""
    if torch.cuda.memory_reserved(device) > limit:
        torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(max(limit / total, 0.0), 1.0))


class GpuMemory:
    """Decides how many rows of f_rest and its averages stay on the GPU; `spill` of the model, which it makes room for.

    limit: bytes for torch and spilled tensors together, 0: no limit, so that nothing is spilled.
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
        self._each, self._spillable = training_bytes(gaussians, 1, 0, absolute), spillable_bytes(gaussians, 1)
        self._fixed = training_bytes(gaussians, 0, pixels) + photo_bytes(images, device)
        gaussians.spill = self.room
        self._limit_torch(0)

    def expect(self, count: int) -> None:
        """Take note of a number of this process's Gaussians that will come: a limit begins where they do not fit."""
        if self.limit or self._device.type != "cuda":
            return
        limit = int(_USABLE * (free_memory(self._device) + torch.cuda.memory_allocated(self._device)))
        if self._near(limit, count) < count:
            self.limit = limit
            self._limit_torch(0)

    def room(self, like: Tensor, rows: int) -> Tensor | None:
        """An uninitialised tensor for so many rows of f_rest; None: all may stay on the GPU."""
        near = self.near_rows(rows)
        if near >= rows:
            self._limit_torch(0)
            return None
        size = near * math.prod(like.shape[1:]) * like.element_size()
        self._limit_torch(size)
        return empty_rows(like, rows, size)

    def near_rows(self, count: int) -> int:
        """How many of so many rows stay on the GPU."""
        return self._near(self.limit, count) if self.limit else count

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
                f"the bus to that memory will bind: about {milliseconds:.0f} ms a step, which concerns {seen:.0%} of "
                "the Gaussians"
            )
        return said

    def _near(self, limit: int, count: int) -> int:
        others = self._fixed + count * (self._each - self._spillable)
        return near_rows(limit, count, others, count * self._spillable)

    def _limit_torch(self, each: int) -> None:
        """Leave torch the limit less the near parts of spilled tensors: three of `each` bytes and the copy of one."""
        if not self.limit or self._device.type != "cuda":
            return
        limit_torch(self.limit - max(4 * each, bytes_of()[0] + each), self._device)
