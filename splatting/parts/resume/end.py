"""The note in model.json that a training has reached its end: only then all of its files are complete."""

import contextlib
import os
import shlex
from pathlib import Path
from typing import Any

from arguments import add_to_model_json
from splatting.files.json_files import MODEL_JSON, read_model_json
from utils.system_utils import UserError

FINISHED = "finished"  # entry of model.json: --iterations of the training that has ended


def finished(folder: str | os.PathLike) -> int:
    """The --iterations of the training that has reached its end in a model folder, 0 if none has."""
    with contextlib.suppress(UserError, OSError):  # a broken file notes nothing
        found = read_model_json(folder).get(FINISHED)
        return found if type(found) is int and found > 0 else 0
    return 0


def continues(folder: str | os.PathLike, iterations: int) -> bool:
    """Whether the finished training of so many --iterations left the checkpoint of its end, as none by the clock does.

    Checkpoints of earlier iterations, as of Ctrl-C, repeat what the training then did.
    """
    return (Path(folder) / f"chkpnt{iterations}.pth").is_file()


def note_finished(run: Any) -> None:
    """Note that a training has reached its end."""
    folder = Path(run.scene.model_path)
    if not (folder / MODEL_JSON).is_file():  # the folder was removed meanwhile, which is told of
        return
    add_to_model_json(folder, **{FINISHED: run.opt.iterations})


def checkpoint_line(path: Path) -> str:
    """How to continue a training from its last checkpoint."""
    size = f"{path.stat().st_size / 1e6:.3g} MB"
    return (
        f"Last checkpoint: {shlex.quote(str(path))} ({size}); the same command with --resume and more --iterations "
        "continues this training"
    )
