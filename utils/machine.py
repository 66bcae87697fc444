"""What a measurement was made on."""

import platform
from pathlib import Path

import torch


def cpu_name() -> str:
    """The processor's name, from the kernel where it tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def device_name(device: torch.device) -> str:
    """The name of the GPU or of the processor that `device` stands for."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()
