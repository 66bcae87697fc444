"""Free and used memory, and recognition of out-of-memory errors.

torch is imported on first use: not every program needs it.
"""

from __future__ import annotations

import contextlib
import re
import resource
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

# Words of torch on CPU and GPU, of C++ and CUDA, and of the rasterizer for more instances than it can count.
_WORDS = ("can't allocate memory", "not enough memory", "out of memory", "bad_alloc", "more than 2^31")
_ASKED = re.compile(r"(?:[Tt]ried|Unable) to allocate ([\d.]+) ?(bytes|[KMGT]iB)")
_UNITS = {"bytes": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
_CGROUP = Path("/sys/fs/cgroup")


def is_out_of_memory(error: BaseException | None) -> bool:
    """Tell whether an error, or its cause, means that memory ran out or that there are too many instances to count."""
    if error is None:
        return False
    if isinstance(error, RuntimeError):  # torch.OutOfMemoryError is one, too
        return any(words in str(error) for words in _WORDS)
    return isinstance(error, MemoryError) or is_out_of_memory(error.__cause__)


def describe_shortage(error: BaseException, device: torch.device | str) -> str:
    """Describe an out-of-memory error: the bytes asked for, or the error's own words, and the free bytes if known."""
    import torch

    asked, free = _ASKED.search(str(error)), free_memory(device)
    if asked:
        parts = [f"{gib(float(asked[1]) * _UNITS[asked[2]])} asked for"]
    else:
        parts = [re.split("[:;\n]", str(error) or type(error).__name__)[0]]
    if free is not None:
        parts.append(f"{gib(free)} free on the {'GPU' if torch.device(device).type == 'cuda' else 'CPU'}")
    return ", ".join(parts)


def gib(count: float) -> str:
    """Bytes as text in GiB."""
    return f"{count / 2**30:.2f} GiB" if count < 9.995 * 2**30 else f"{count / 2**30:.1f} GiB"


def free_memory(device: torch.device | str) -> int | None:
    """Bytes that can still be allocated on a device; None if the system does not tell.

    CPU: the kernel's available memory, or less if the container (control group) or a limit of the process (ulimit -v)
    allows less. GPU: the driver's free memory, and memory that torch holds unused, or less if torch may take less.
    """
    import torch

    device = torch.device(device)
    if device.type == "cuda":
        taken, (free, total) = torch.cuda.memory_allocated(device), torch.cuda.mem_get_info(device)
        most = int(torch.cuda.get_per_process_memory_fraction() * total)
        return max(min(free + torch.cuda.memory_reserved(device), most) - taken, 0)
    known = [value for value in (_read_available(), _read_group_limit(), _read_process_limit()) if value is not None]
    return min(known, default=None)


def peak_memory_mib(device: torch.device) -> float | None:
    """Peak memory so far in MiB: torch's on a GPU, else the resident memory; None if the system does not say."""
    import torch

    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    try:
        # getrusage would also count the peak of the process that started this one, because exec keeps it.
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 2**10  # kB
    except (OSError, ValueError, IndexError):
        return None


def _read_available() -> int | None:
    """Read the bytes of memory that are available, from Linux; None on other systems."""
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return None


def _read_group_limit() -> int | None:
    """Bytes below the limit of this process's control group (version 2, or 1); None without a limit."""
    for limit, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        with contextlib.suppress(OSError, ValueError):
            most = int((_CGROUP / limit).read_text())  # ValueError: the word "max"
            stat = (_CGROUP / limit).with_name("memory.stat").read_text()
            cached = re.search(r"^(?:total_)?inactive_file (\d+)$", stat, re.MULTILINE)  # the kernel frees it on demand
            return max(most - int((_CGROUP / used).read_text()) + (int(cached[1]) if cached else 0), 0)
    return None


def _read_process_limit() -> int | None:
    """Bytes of address space left to this process; None without a limit."""
    if (most := resource.getrlimit(resource.RLIMIT_AS)[0]) == resource.RLIM_INFINITY:
        return None
    with contextlib.suppress(OSError, ValueError):
        return max(most - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize(), 0)
    return None
