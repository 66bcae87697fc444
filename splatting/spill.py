"""A limit of the GPU memory that a training takes (--gpu_memory): SH bands that do not fit lie in the host's memory.

The limit must begin before the first rows exist, because the rows of a checkpoint may not fit on the GPU at all. So the
model gets its storage while it is empty.
"""

import argparse
import math
from typing import Any

import torch
from torch import Tensor

from groundwork.host.memory import free_memory, gib
from scene import sleeping
from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.spilled import Storage, bytes_of, empty_rows, is_spilled
from scene.in_view import share_of
from scene.scene import Scene
from splatting.resources import (
    PER_PIXEL,
    REMEDY,
    announce_device,
    expected_count,
    largest_view,
    photo_bytes,
    training_bytes,
    warn_of,
)
from utils.system_utils import UserError

_BUS = 40e9  # bytes a second that kernels read or write in the host's memory
_SLOW = 10.0  # milliseconds a step, from which on the bus is named
_USABLE = 0.95  # of a GPU's free memory, where nobody has given a limit; torch cannot fill what it holds
_PAGE = 2 << 20  # bytes; a spilled tensor has whole pages in each memory
_SPARE = 0.03  # of a limit, what torch cannot fill of its blocks; and at least
_LEAST_SPARE = 1 << 27  # bytes, for the lists of the first step
_WHOLE_STEP = 20  # bytes of a Gaussian besides the estimate, in steps for which all blocks wake


def spillable_bytes(gaussians: GaussianModel, count: int) -> int:
    """Return the bytes of `count` Gaussians that the host may hold: SH bands above 0 and their two averages."""
    return count * 4 * 3 * math.prod(gaussians._attributes["f_rest"].shape)


def resident_rows(limit: float, count: int, others: float, spillable: float) -> int:
    """Return the number of spillable rows that stay on a GPU of which `limit` bytes may be taken.

    count: all rows.
    others: bytes of all that cannot be spilled.
    spillable: bytes of the rows.
    """
    return max(min(int(count * (limit - others) / spillable), count), 0) if spillable else count


class GpuMemory(Storage):
    """Decides how many rows of f_rest and its averages stay on the GPU.

    While rows change, new tensors find the GPU's memory taken by the old ones. What lacks memory lies on the host until
    `rebalance` brings it back. Nothing is spilled before `limit_for` knows the scene.

    limit: bytes for torch and spilled tensors together, 0: no limit, so that nothing is spilled.
    """

    def __init__(self, limit: float, gaussians: GaussianModel, absolute: bool, device: torch.device) -> None:
        """Take a limit in GiB, 0 for none.

        absolute: true with absolute gradients.
        """
        self.limit, self._device = int(limit * 2**30), device
        self._each = training_bytes(gaussians, 1, 0, absolute) + _WHOLE_STEP
        self._spillable = spillable_bytes(gaussians, 1)
        self._fixed = 0
        if self.limit and device.type == "cuda":  # other programs may have a part of what was given
            there = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
            self.limit = min(self.limit, int(_USABLE * there))
        self._limit_torch(0)

    def limit_for(self, count: int, scene: Scene) -> None:
        """Set a limit by the free memory of the GPU if a number of Gaussians does not fit there.

        A limit that is set already stays.

        count: number of Gaussians of this process, now or later.
        scene: scene whose photos and largest view need memory, too.
        """
        self._fixed = PER_PIXEL * largest_view(scene) + photo_bytes(scene.images, self._device)
        if self.limit or self._device.type != "cuda" or not CAN_SPILL:
            return
        limit = int(_USABLE * (free_memory(self._device) + torch.cuda.memory_allocated(self._device)))
        if self._needed_bytes(count, limit) > limit:
            self.limit = limit
            self._limit_torch(0)

    def empty_rows(self, like: Tensor, rows: int) -> Tensor | None:
        """Return an uninitialised tensor for so many rows of f_rest; None: all may stay on the GPU."""
        if not self._spills(rows):
            self._limit_torch(0)
            return None
        each = self._resident_bytes(like, rows)
        size = max(min(each, 3 * each - bytes_of()[0]), 0) if is_spilled(like) else 0
        self._limit_torch(max(3 * each, bytes_of()[0] + size))
        return empty_rows(like, rows, size)

    def rebalance(self, gaussians: GaussianModel) -> None:
        """Bring rows to the GPU that fit there, now that rows have changed."""
        if not self.limit or not self._spills(len(gaussians)):
            return
        rest = gaussians.raw("f_rest")
        state = gaussians.optimizer.state.get(rest, {})
        rest.data = self._move_rows(rest.data)
        for name in ("exp_avg", "exp_avg_sq"):
            if name in state:
                state[name] = self._move_rows(state[name])

    def _move_rows(self, values: Tensor) -> Tensor:
        wanted = self._resident_bytes(values, len(values))
        if not is_spilled(values) or bytes_of(values)[0] > wanted - _PAGE:
            return values
        return empty_rows(values, len(values), wanted).copy_(values)

    def _resident_bytes(self, like: Tensor, rows: int) -> int:
        """Return the bytes of so many rows of one tensor that may stay on the GPU."""
        return self.resident_rows(rows) * math.prod(like.shape[1:]) * like.element_size()

    def _spills(self, count: int) -> bool:
        """Tell whether so many rows do not fit, with all that a change of them needs."""
        return self.limit > 0 and self._needed_bytes(count, self.limit) > self.limit

    def _needed_bytes(self, count: int, limit: int) -> int:
        return self._fixed + max(int(_SPARE * limit), _LEAST_SPARE) + count * self._each

    def resident_rows(self, count: int) -> int:
        """Return the number of rows that stay on the GPU, of `count` rows."""
        if not self._spills(count):
            return count
        # The estimate has room for the copy of one of three tensors while rows change, which here lies on the host.
        others = self._needed_bytes(count, self.limit) - count * self._spillable * 4 / 3
        return resident_rows(self.limit, count, others, count * self._spillable)

    def host_bytes(self, count: int) -> int:
        """Return the bytes of so many Gaussians in the host's memory."""
        return self._spillable * (count - self.resident_rows(count)) if self._device.type == "cuda" else 0

    def remedy(self, count: int, lacking: float) -> str:
        """Return the option as a remedy, if nobody has set it and spilling frees the lacking bytes; otherwise ""."""
        helps = self._device.type == "cuda" and not self.limit and lacking <= count * self._spillable
        return "set --gpu_memory, or " if helps else ""

    def _limit_torch(self, near: int) -> None:
        """Leave torch the limit less so many bytes, or less those that spilled tensors have now."""
        if self.limit and self._device.type == "cuda":
            limit_torch(self.limit - max(near, bytes_of()[0]), self._device)


CAN_SPILL = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 11)  # csrc/torch/spilled.cpp
_before: list[float] = []  # the share of the GPU that torch might take before it got a limit; empty without one


def limit_torch(limit: float, device: torch.device) -> None:
    """Leave torch so many bytes of the GPU; `free_memory` then counts no others.

    Torch's segments then grow and shrink, because lists that change their size would leave holes of a fifth of the
    limit.
    """
    if not _before:
        _before.append(torch.cuda.get_per_process_memory_fraction())
    if CAN_SPILL:
        torch._C._accelerator_setAllocatorSettings("expandable_segments:True")
    if torch.cuda.memory_reserved(device) > limit:
        torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(max(limit / total, 0.0), 1.0))


def release_torch() -> None:
    """Let torch take as much as it might before the limit."""
    while _before:
        torch.cuda.set_per_process_memory_fraction(_before.pop())


def make_storage(
    gaussians: GaussianModel, opt: argparse.Namespace, device: torch.device, absolute: bool
) -> GpuMemory | None:
    """Return the storage of an empty model on a GPU, which may be too small without the option; None on a CPU.

    absolute: true if the statistics may take absolute gradients.
    """
    if opt.gpu_memory:
        refuse_without_gpu(device.type)
    release_torch()  # from the limit of a training that was refused after this
    if device.type != "cuda" and not opt.gpu_memory:
        return None
    return GpuMemory(opt.gpu_memory, gaussians, absolute, device)


def refuse_without_gpu(device: str) -> None:
    """Raise UserError where there is no GPU whose memory could be limited."""
    if device != "cuda":
        raise UserError("--gpu_memory limits the memory of a GPU, and there is none to use; leave it out")


def announce_spilled(run: Any, memory: GpuMemory) -> None:
    """Print how many bytes lie in the host's memory, and how long their transfers take in a step.

    Both are those of the most Gaussians to come. Warn if the host has too little memory for the expected number.
    """
    now, most, size = run.gaussians.gaussian_count, run.strategy.max_gaussians, run.group.size
    later = expected_count(most, now)
    if far := memory.host_bytes(-(-later // size)):
        _announce_host(run.scene.images, far, f"{later:,} Gaussians", size)
    count = -(-max(now, most) // size)
    if memory.host_bytes(count):
        share = share_of(run.scene, run.device)
        dense = run.sleeping is None and type(run.gaussians.optimizer) is GaussianAdam
        same = run.sleeping is None or share < sleeping.MOST_SHARE  # blocks would sleep in any case
        print("\n".join(sentences(memory, count, 1.0 if dense else share, same)))


def _announce_host(images: Any, needed: int, what: str, size: int) -> None:
    """Print the memory that the host needs for spilled rows, beside photos there; warn if it does not fit."""
    host = torch.device("cpu")
    pictures = images.planned_bytes if images.keep_on == host else 0
    each = f" for each of {size} processes" if size > 1 else ""
    room = announce_device(host, f"{gib(needed)} of {what}{each}", pictures, pictures + needed)
    if room < needed:
        warn_of(host, what, f"set a lower --max_num_splats, or {REMEDY}")


def sentences(memory: GpuMemory, count: int, seen: float, same: bool) -> list[str]:
    """Return lines to print before a training of `count` Gaussians of which some are spilled.

    seen: share of the Gaussians that a step concerns.
    same: true if spilling does not change the files.
    """
    spilled = memory.host_bytes(count)
    said = [
        f"{gib(spilled)} of {count:,} Gaussians are kept in the host's memory, as all of them need more than "
        f"{gib(memory.limit)} of the GPU's; the saved files are the same" + ("" if same else " up to rounding")
    ]
    milliseconds = 1e3 * 2 * spilled * seen / _BUS
    if milliseconds > _SLOW:
        said.append(
            f"transfers from and to that memory limit the speed to about {milliseconds:.0f} ms a step, which updates "
            f"{seen:.0%} of the Gaussians"
        )
    return said
