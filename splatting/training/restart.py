"""Checkpoints of the training that torchrun has started: where a restarted one goes on, and what a fault leaves."""

import os
import re
import time
from pathlib import Path

from splatting.host import torchrun
from splatting.host.clock import seconds_since_start

_CHECKPOINT = re.compile(r"chkpnt(\d+)\.pth")


def resumed(start: str | None, folder: str, iterations: int) -> str | None:
    """The checkpoint to begin with: `start`, or after a restart (--max-restarts) the newest one of this training.

    folder: of the output. A checkpoint that leaves nothing to do is none.
    """
    newest = newest_checkpoint(folder, iterations) if torchrun.restarts() else None
    if newest:
        print(f"Restarted by torchrun: resuming {newest}")
    return newest or start


def newest_checkpoint(folder: str, below: float = float("inf")) -> str | None:
    """The chkpntN.pth of the highest N under `below` that torchrun's processes have written, over all restarts.

    Those of earlier trainings in the folder are older than torchrun.
    """
    began = time.time() - (seconds_since_start(os.getppid()) or float("inf"))
    found = {}
    for path in Path(folder).glob("chkpnt*.pth"):
        match = _CHECKPOINT.fullmatch(path.name)
        if match and int(match[1]) < below and path.stat().st_mtime >= began:
            found[int(match[1])] = path
    return str(found[max(found)]) if found else None


def what_stands(folder: str, start: str | None) -> str:
    """Words about the last checkpoint, for an end that cannot save one. start: the one that the training began with."""
    newest = newest_checkpoint(folder) or start
    if newest is None:
        return "no checkpoint was saved; start again, with --checkpoint_iterations"
    return f"the last checkpoint is complete: resume with --start_checkpoint {newest}"
