"""What a training says before it starts of the rows that will lie in the host's memory."""

from typing import Any

import torch

from scene import sleeping
from scene.sampling_rate import share_of
from splatting.findings.resources import REMEDY, announce_device, expected_count, warn_of
from splatting.host.memory import gib
from splatting.parts.spill.gpu_memory import GpuMemory

_BUS = 40e9  # bytes a second that kernels read or write in the host's memory
_SLOW = 10.0  # milliseconds a step, from which on the bus is named


def announce(run: Any, memory: GpuMemory) -> None:
    """Say what lies in the host's memory, now or once there are as many Gaussians as there may be, and what it costs.

    Warn if the host has too little for what is expected.
    """
    now, most, size = run.gaussians.gaussian_count, run.density.max_gaussians, run.group.size
    later = expected_count(most, now)
    if far := memory.host_bytes(-(-later // size)):
        _announce_host(run.scene.images, far, f"{later:,} Gaussians", size)
    count = -(-max(now, most) // size)
    if memory.host_bytes(count):
        share = share_of(run.scene, run.device)
        dense = run.sleeping is None and run.opt.optimizer_type == "default"
        same = run.sleeping is None or share < sleeping.MOST_SHARE  # blocks would sleep in any case
        print("\n".join(sentences(memory, count, 1.0 if dense else share, same)))


def _announce_host(images: Any, needed: int, what: str, size: int) -> None:
    """Print what the host has to hold, besides photos there; warn if it does not fit."""
    host = torch.device("cpu")
    pictures = images.planned_bytes if images.keep_on == host else 0
    each = f" for each of {size} processes" if size > 1 else ""
    room = announce_device(host, f"{gib(needed)} of {what}{each}", pictures, pictures + needed)
    if room < needed:
        warn_of(host, what, f"set a lower --max_num_splats, or {REMEDY}")


def sentences(memory: GpuMemory, count: int, seen: float, same: bool) -> list[str]:
    """What to say before a training of so many Gaussians, of which some are spilled.

    seen: the part of them that a step concerns. same: whether the files do not depend on that.
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
