"""Seconds and memory that the running process has used so far."""

import os
import time
from pathlib import Path

import torch

_IMPORTED = time.perf_counter()


def seconds_since_start(process: int | None = None) -> float | None:
    """Seconds since this process, or another one, started, to a clock tick; None if the system does not say."""
    try:
        # The command's name, in brackets, may have spaces. Field 22 of proc(5) is the start in clock ticks since boot.
        fields = Path(f"/proc/{process or 'self'}/stat").read_text().rpartition(")")[2].split()
        started = int(fields[22 - 3]) / os.sysconf("SC_CLK_TCK")
        least = 0.0 if process else time.perf_counter() - _IMPORTED
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - started, least)
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def wall_seconds() -> float:
    """Seconds since the process started, or since the import of this module if the system does not say."""
    known = seconds_since_start()
    return time.perf_counter() - _IMPORTED if known is None else known


def peak_memory_mib(device: torch.device) -> float | None:
    """Peak memory so far in MiB: torch's on a GPU, else the resident memory; None if the system does not say."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    try:
        # getrusage would also count the peak of the process that started this one, because exec keeps it.
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 2**10  # kB
    except (OSError, ValueError, IndexError):
        return None
