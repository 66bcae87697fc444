"""Energy of GPUs as their driver counts it, by NVML: unknown without the package nvidia-ml-py.

torch is imported on first use: not every program needs it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def nvml_name(device: torch.device) -> str | None:
    """The name by which NVML knows a GPU; None for a CPU, and where torch does not tell."""
    if device.type != "cuda":
        return None
    import torch

    uuid = getattr(torch.cuda.get_device_properties(device), "uuid", None)
    return None if uuid is None else f"GPU-{uuid}"


def joules_counter(gpus: Sequence[str | None]) -> Callable[[], float] | None:
    """A function that returns the joules that GPUs have used since their driver was loaded; only differences count.

    gpus: names from `nvml_name`; a GPU named twice counts once. The function returns NaN once the driver fails. None if
    NVML does not know one of the GPUs on this host, or the GPU does not count its energy.
    """
    if None in gpus:
        return None
    try:
        import pynvml
    except ImportError:
        return None
    try:
        pynvml.nvmlInit()
        handles = [pynvml.nvmlDeviceGetHandleByUUID(name) for name in dict.fromkeys(gpus)]
    except pynvml.NVMLError:
        return None

    def joules() -> float:
        try:
            return sum(map(pynvml.nvmlDeviceGetTotalEnergyConsumption, handles)) / 1000  # it gives millijoules
        except pynvml.NVMLError:
            return math.nan

    return None if math.isnan(joules()) else joules
