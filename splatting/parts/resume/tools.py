"""Where a training begins that --resume is given to."""

import argparse
import math
from pathlib import Path

from scene.saved_model import saves_in
from splatting.files.json_files import read_model_json
from splatting.parts.resume.end import End, finished
from splatting.registry import tools
from splatting.training.folder import REPLACED, folder_of, newest_checkpoint, own_folder
from splatting.training.schedule import STEADY
from utils.system_utils import UserError


def prepare(dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace) -> bool:
    """Let --resume name the checkpoint to start with. Returns whether there is anything to train.

    UserError without a folder, and for a finished training that cannot be continued so.
    """
    if not getattr(launch, "resume", False):
        return True
    folder = dataset.model_path or folder_of(launch.start_checkpoint)
    if not folder:
        raise UserError("--resume needs -m, the folder whose training it resumes or starts")
    asked = next((found for ask in tools("continues") if (found := ask(opt)) is not None), None)
    if end := finished(folder):
        launch.start_checkpoint = str(end.checkpoint)
        return _continued(folder, end, end.iteration < opt.iterations if asked is None else asked, asked is None)
    most = opt.iterations if asked is None else math.inf
    launch.start_checkpoint = newest_checkpoint(folder, most, since=0) or launch.start_checkpoint
    if not launch.start_checkpoint and saves_in(Path(folder)) and not read_model_json(folder):
        raise UserError(f"{folder} has a model, and no checkpoint to continue; leave --resume out to start over")
    return True


def _continued(folder: str, end: End, asked: bool, by_iterations: bool) -> bool:
    """Whether to continue the finished training of a folder. UserError if it cannot be, or not by --iterations."""
    there = f"{folder} has a finished training of {end.iteration:,} iterations"
    wrong = by_iterations and end.more != STEADY.more
    if not asked and not wrong:
        with own_folder(folder):  # which removes what a training leaves that was killed after its note
            (Path(folder) / REPLACED).unlink(missing_ok=True)
        print(
            f"{there}; {end.more} continues it" if end.checkpoint.is_file() else f"{there} and no checkpoint of its end"
        )
        return False
    if not end.checkpoint.is_file():
        raise UserError(f"{there}, which left no checkpoint to continue; leave --resume out to start over")
    if wrong:
        raise UserError(f"{there}; give --resume with {end.more} to continue it, or leave --resume out to start over")
    return True
