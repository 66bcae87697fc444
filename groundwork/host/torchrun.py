"""Facts that torchrun tells each process that it starts, by the environment. A process of another parent is alone."""

import os

_NAMES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")


def size() -> int:
    """Number of processes that work together, over all hosts."""
    return _number("WORLD_SIZE", 1) if all(name in os.environ for name in _NAMES) else 1


def rank() -> int:
    """This process's number among them, from 0."""
    return _number("RANK", 0) if size() > 1 else 0


def local_rank() -> int:
    """This process's number among those of its host, which is the number of its GPU."""
    return _number("LOCAL_RANK", 0) if size() > 1 else 0


def local_size() -> int:
    """Number of processes of this host."""
    return max(_number("LOCAL_WORLD_SIZE", 1), 1) if size() > 1 else 1


def restarts() -> int:
    """How often torchrun has started all processes again after a fault (--max-restarts)."""
    return _number("TORCHELASTIC_RESTART_COUNT", 0)


def _number(name: str, default: int) -> int:
    value = os.environ.get(name, "")
    return int(value) if value.isdigit() else default
