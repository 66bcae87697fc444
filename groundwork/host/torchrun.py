"""The environment variables that torchrun sets for each process. Without them, a process is alone."""

import os

_NAMES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")


def size() -> int:
    """Number of processes that work together, over all hosts."""
    return _read_number("WORLD_SIZE", 1) if all(name in os.environ for name in _NAMES) else 1


def rank() -> int:
    """Number of this process among all of them, from 0."""
    return _read_number("RANK", 0) if size() > 1 else 0


def local_rank() -> int:
    """Number of this process among those of its host, and of its GPU."""
    return _read_number("LOCAL_RANK", 0) if size() > 1 else 0


def local_size() -> int:
    """Number of processes of this host."""
    return max(_read_number("LOCAL_WORLD_SIZE", 1), 1) if size() > 1 else 1


def restarts() -> int:
    """Number of times that torchrun has started all processes again after a fault (--max-restarts)."""
    return _read_number("TORCHELASTIC_RESTART_COUNT", 0)


def _read_number(name: str, default: int) -> int:
    value = os.environ.get(name, "")
    return int(value) if value.isdigit() else default
