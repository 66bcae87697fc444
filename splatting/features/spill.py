"""A limit of the GPU memory that a training takes (--gpu_memory): SH bands that do not fit lie in the host's memory.

The limit must begin before the first rows exist, because the rows of a checkpoint may not fit on the GPU at all. So the
part provides the model's storage in `check`, while the model is empty, not in `begin`.
"""

import argparse
from typing import Any

import torch

from groundwork.host.memory import gib
from scene import sleeping
from scene.gaussians.adam import GaussianAdam
from scene.in_view import share_of
from splatting.features.spill_memory import GpuMemory, release_torch
from splatting.iteration import Iteration
from splatting.part import Error, Part, fill
from splatting.resources import REMEDY, announce_device, expected_count, warn_of
from utils.system_utils import UserError

_BUS = 40e9  # bytes a second that kernels read or write in the host's memory
_SLOW = 10.0  # milliseconds a step, from which on the bus is named


class Spill(Part):
    """Provides the model's storage, prints how much of it lies on the host, and brings back what fits after a change.

    The part is in every training: without the option, a limit begins where a GPU is too small.
    """

    name = "spill"

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        return True

    def check(self, run: Any, state: Any) -> None:
        if run.opt.gpu_memory:
            refuse_without_gpu(run.device.type)
        release_torch()  # from the limit of a training that was refused after this
        self._model = run.gaussians
        absolute = any(strategy.takes_absolute(run.opt) for strategy in run.strategies)
        fill(self._model, "storage", GpuMemory(run.opt.gpu_memory, self._model, absolute, run.device), self)

    def ready(self, run: Any) -> None:
        self._model.storage.reserve(-(-run.strategy.max_gaussians // run.group.size), run.scene)

    def opened(self, run: Any) -> None:
        announce(run, self._model.storage)
        self._model.storage.rebalance(self._model)

    def after_step(self, at: Iteration) -> None:
        if at.changes:
            self._model.storage.rebalance(self._model)

    def ended(self, error: Error) -> None:
        release_torch()


def refuse_without_gpu(device: str) -> None:
    """Raise UserError where there is no GPU whose memory could be limited."""
    if device != "cuda":
        raise UserError("--gpu_memory limits the memory of a GPU, and there is none to use; leave it out")


def announce(run: Any, memory: GpuMemory) -> None:
    """Print how much lies in the host's memory, now or with the most Gaussians to come, and the time that this takes.

    Warn if the host has too little memory for the expected number.
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
