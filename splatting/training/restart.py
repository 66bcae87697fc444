"""Checkpoints of the training that torchrun has started: where a restarted one continues."""

import os
import re
import time
from pathlib import Path
from zipfile import is_zipfile

from splatting.host import torchrun
from splatting.host.clock import seconds_since_start

REPLACED = "chkpnt_resume.pth"  # one that is replaced while the training goes on, never of its last iteration
_CHECKPOINT = re.compile(r"chkpnt(\d+)\.pth|" + re.escape(REPLACED))


def resumed(start: str | None, folder: str, iterations: int) -> str | None:
    """The checkpoint to begin with: `start`, or after a restart (--max-restarts) the newest one of this training.

    folder: of the output. A checkpoint that leaves nothing to do is none.
    """
    newest = newest_checkpoint(folder, iterations) if torchrun.restarts() else None
    if newest:
        print(f"Restarted by torchrun: resuming {newest}")
    return newest or start


def newest_checkpoint(folder: str, below: float = float("inf"), since: float | None = None) -> str | None:
    """The newest whole checkpoint of an iteration under `below`; of equally new ones, that of the highest.

    since: when it was written, in seconds since 1970. None: since torchrun began, so that it is of its processes, over
    all restarts, and of no earlier training in the folder.
    """
    began = time.time() - (seconds_since_start(os.getppid()) or float("inf")) if since is None else since
    found = {}
    for path in Path(folder).glob("chkpnt*.pth"):
        match = _CHECKPOINT.fullmatch(path.name)
        if match and is_zipfile(path) and (number := int(match[1] or 0)) < below:
            written = path.stat()
            if written.st_mtime >= began:
                found[written.st_mtime_ns, number] = path
    return str(found[max(found)]) if found else None
