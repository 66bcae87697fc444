"""The note in model.json that a training has reached its end: only then all of its files are complete."""

import contextlib
import os
import shlex
from pathlib import Path
from typing import Any, NamedTuple

from arguments import add_to_model_json
from splatting.files.json_files import MODEL_JSON, read_model_json
from splatting.training.schedule import STEADY
from utils.system_utils import UserError

FINISHED, MORE = "finished", "continued_by"  # entries of model.json: the last iteration, and the option for more


class End(NamedTuple):
    """The end of a training: its last iteration, the option that continues it, and the checkpoint that it leaves."""

    iteration: int
    more: str
    checkpoint: Path


def finished(folder: str | os.PathLike) -> End | None:
    """The end of the training in a model folder, None if it has not reached it. The checkpoint may not be there."""
    with contextlib.suppress(UserError, OSError):  # a broken file notes nothing
        note = read_model_json(folder)
        found = note.get(FINISHED)
        if type(found) is int and found > 0:
            return End(found, str(note.get(MORE, STEADY.more)), Path(folder) / f"chkpnt{found}.pth")
    return None


def note_finished(run: Any) -> None:
    """Note that a training has reached its end."""
    folder = Path(run.scene.model_path)
    if not (folder / MODEL_JSON).is_file():  # the folder was removed meanwhile, which is told of
        return
    add_to_model_json(folder, **{FINISHED: run.schedule.ends, MORE: run.schedule.more})


def checkpoint_line(path: Path, more: str) -> str:
    """How to continue a training from its last checkpoint."""
    size = f"{path.stat().st_size / 1e6:.3g} MB"
    return f"Last checkpoint: {shlex.quote(str(path))} ({size}); --resume with {more} continues this training"
