"""Number of processors that this process may use; a container may allow fewer than the machine has."""

import math
import os
from pathlib import Path

from splatting.host import torchrun

MOST_THREADS = 16  # for work on image files: more threads only wait for memory and disk
_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def cores() -> int:
    """Processors allowed by affinity (taskset, Slurm) and by the quota of the process's cgroups (Docker's --cpus).

    Processes that train together on this host share them evenly.
    """
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(count, _quota())) // torchrun.local_size())


def threads(most: int = MOST_THREADS) -> int:
    """Number of threads for work that releases Python's lock: one for each of `cores`, `most` at most."""
    return min(cores(), most)


def _quota() -> float:
    """Processors that the cgroup and those around it may use (cpu.max of version 2); infinite without a limit."""
    try:
        own = next(line[3:] for line in _OWN_CGROUPS.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return math.inf
    folder = _CGROUPS / own.lstrip("/")
    found = math.inf
    for group in (folder, *folder.parents):
        if not group.is_relative_to(_CGROUPS):
            break
        try:
            quota, period = (group / "cpu.max").read_text().split()
            found = min(found, int(quota) / int(period))
        except (OSError, ValueError):  # the root has none; "max" is no limit
            continue
    return found
