"""Memory that a process keeps for its next allocation, where glibc would give it back to the system.

A step on the CPU frees as much memory as the next one takes. By default, glibc gives memory back as soon as 64 MiB, or
less, lie free at its end. The system then has to clear it for the next step. Whether that happens depends on chance. It
took up to a tenth of a training (docs/results/tried.md).
"""

import ctypes
import os

_TRIM, _SEPARATE = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt
_KEPT = 256 << 20  # bytes that may lie free
_LARGE = 32 << 20  # bytes of an allocation that is given back as soon as it is freed; glibc allows no more


def keep_freed_memory() -> None:
    """Let this process keep it. Without glibc, or where the environment has limits of its own, nothing changes."""
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(_SEPARATE, _LARGE)
    mallopt(_TRIM, _KEPT)
