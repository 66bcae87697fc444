"""Notes of ranks for each other, in torchrun's key-value store, which outlives each of them."""

import json
import os
import socket
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch.distributed as dist

from splatting.host import torchrun
from splatting.host.errors import UserError, first_line

_STATE = 2  # of the fields of /proc/PID/stat, from 1 on after the name
_WAIT = timedelta(minutes=10)  # for the store itself, as long as torchrun starts on another host
_LOOK = 0.05  # seconds


class KeyValueStore:
    """A connection to the store. Each thread needs its own: a call that waits holds it."""

    def __init__(self, rank: int, size: int) -> None:
        """Connect, to the address that torchrun gives. UserError if nobody answers there."""
        self.rank, self.size = rank, size
        try:
            store, _, _ = next(dist.rendezvous("env://", rank, size, timeout=_WAIT))
        except (RuntimeError, ValueError) as error:
            place = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
            raise UserError(f"no store of torchrun at {place} ({first_line(error)}); start all ranks anew") from error
        # The store outlives a restart of all ranks, and the notes of those before it are not for these.
        self.raw = dist.PrefixStore(f"notes/{torchrun.restarts()}", store)

    def post(self, name: str, value: Any) -> None:
        """Leave a note for all, in place of this rank's last one of that name."""
        self.raw.set(f"{name}/{self.rank}", json.dumps(value))

    def read(self, name: str) -> dict[int, Any]:
        """Everyone's notes of a name that are there, by rank."""
        keys = {rank: f"{name}/{rank}" for rank in range(self.size)}
        return {rank: json.loads(self.raw.get(key)) for rank, key in keys.items() if self.raw.check([key])}

    def everyone(self, name: str) -> list[Any]:
        """The notes of all ranks, once all are there."""
        while len(notes := self.read(name)) < self.size:
            time.sleep(_LOOK)  # and not in the store, where no signal would be noticed
        return [notes[rank] for rank in range(self.size)]

    def claim(self, name: str) -> bool:
        """Whether this rank is the first to ask for a name."""
        return self.raw.add(name, 1) == 1


def here() -> list:
    """This process: host, number, and the space of process numbers, which containers have of their own."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return [socket.gethostname(), os.getpid(), space]


def is_gone(who: list) -> bool:
    """Whether a process, as `here` gave it, is one of this host and has ended. False if that cannot be seen."""
    mine = here()
    if who[0] != mine[0] or who[2] != mine[2] or not mine[2]:
        return False
    try:
        fields = Path(f"/proc/{who[1]}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return fields[_STATE - 2] in "ZX"
