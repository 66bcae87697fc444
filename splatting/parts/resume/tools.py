"""Where a training begins that --resume is given to."""

import argparse
from pathlib import Path

from splatting.parts.resume.end import continues, finished
from splatting.training.output_folder import folder_of, own_folder
from splatting.training.restart import REPLACED, newest_checkpoint
from utils.system_utils import UserError


def prepare(dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace) -> bool:
    """Let --resume name the checkpoint to start with. Returns whether there is anything to train.

    UserError without a folder.
    """
    if not getattr(launch, "resume", False):
        return True
    folder = dataset.model_path or folder_of(launch.start_checkpoint)
    if not folder:
        raise UserError("--resume needs -m, the folder whose training it resumes or starts")
    done = finished(folder)
    if done >= opt.iterations:
        with own_folder(folder):  # which removes what a training leaves that was killed after its note
            (Path(folder) / REPLACED).unlink(missing_ok=True)
        if continues(folder, done):
            what = "give more to continue it"
        else:
            what = "it left no checkpoint of its end to continue; leave --resume out to start over"
        print(f"{folder} has a finished training of --iterations {done}; {what}")
        return False
    launch.start_checkpoint = newest_checkpoint(folder, opt.iterations, since=0) or launch.start_checkpoint
    return True
