"""Resumed trainings (--resume): the same command continues a stopped training, or trains a finished one further.

A note in model.json says that a training has reached its end. Only then all of its files are complete.
"""

import argparse
import contextlib
import math
import os
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from arguments import add_to_model_json
from groundwork.files.json_files import MODEL_JSON, read_model_json
from scene.saved_model import saves_in
from splatting.folder import REPLACED, folder_of, newest_checkpoint, own_folder
from splatting.iteration import Iteration
from splatting.part import Error, Part
from splatting.schedule import STEADY
from utils.system_utils import UserError

FINISHED, MORE = "finished", "continued_by"  # entries of model.json: the last iteration, and the option for more

LEAST = 60.0  # seconds of training between two checkpoints
SHARE = 0.01  # of the seconds of training, which checkpoints take at most
EVERY = 50  # iterations: several processes exchange whether a checkpoint is due, which takes time in each
_BYTES = 720  # of a Gaussian with 59 numbers: each with two averages of Adam, and three statistics
_SPEED = 2e8  # bytes that a disk writes in a second, until it has shown how many


class Resume(Part):
    """Writes checkpoints from time to time (--resume), leaves one at the end, and notes that the end was reached."""

    def __init__(self, run: Any) -> None:
        """Remove the checkpoint that an earlier training wrote from time to time, where a new one begins."""
        self._run, self._file = run, Path(run.scene.model_path) / REPLACED
        self._before = self._spent = 0.0  # seconds of training at the last checkpoint, seconds of writing so far
        self._speed = _SPEED
        self._is_due = False
        if run.start is None and run.group.first:
            self._file.unlink(missing_ok=True)

    def due(self, at: Iteration) -> bool:
        launch = self._run.launch
        asked = launch.resume and not at.last and at.iteration % EVERY == 0
        self._is_due = asked and self._run.group.broadcast_object(self._has_time())
        return self._is_due or self._leaves_checkpoint(at)

    def _has_time(self) -> bool:
        seconds = self._run.clock.seconds
        wanted = self._spent + _BYTES * self._run.gaussians.gaussian_count / self._speed
        return seconds >= self._before + LEAST and wanted <= SHARE * seconds

    def _leaves_checkpoint(self, at: Iteration) -> bool:
        """Tell whether the iteration is the last one, and leaves a checkpoint."""
        launch = self._run.launch
        return at.last and not launch.no_last_checkpoint and not at.takes(launch.checkpoint_iterations)

    def stepped(self, at: Iteration) -> None:
        """Write the checkpoint that `due` has announced, the last one or one between, whose writing is timed."""
        if at.stopping:
            return
        if self._leaves_checkpoint(at):
            self._save(at)
        elif self._is_due:
            begun = time.monotonic()
            self._save(at, self._file.name)
            taken = max(time.monotonic() - begun, 1e-3)
            self._spent += taken
            self._speed = _BYTES * self._run.gaussians.gaussian_count / taken
            self._before = self._run.clock.seconds
        if at.last:
            self._print_checkpoint(Path(self._run.scene.model_path) / f"chkpnt{at.iteration}.pth")

    def _print_checkpoint(self, last: Path) -> None:
        if self._run.group.first and last.is_file():
            tqdm.write(checkpoint_line(last, self._run.schedule.more), file=sys.stdout)

    def _save(self, at: Iteration, name: str = "") -> None:
        """Write a checkpoint. A full disk causes a warning and ends nothing, because nobody has asked for this file."""
        try:
            self._run.checkpoints.save(at, name)
        except UserError as error:
            if not isinstance(error.__cause__, OSError):  # such as a loss that is not finite
                raise
            tqdm.write(f"warning: {error}", file=sys.stderr)

    def ended(self, error: Error) -> None:
        if error is None and self._run.group.first:
            note_finished(self._run)
            self._file.unlink(missing_ok=True)


def warn_of_finished(run: Any) -> None:
    """Warn that a training replaces a finished one in its folder, once nothing can refuse it."""
    folder = run.dataset.model_path
    if run.start is None and run.group.first and (there := read_end(folder)):
        instead = f"; --resume with {there.more} would continue it" if there.checkpoint.is_file() else ""
        print(
            f"warning: {folder} has a finished training of {there.iteration:,} iterations, and this one starts "
            f"over{instead}",
            file=sys.stderr,
        )


def choose_checkpoint(
    dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace, stops: Mapping[str, bool]
) -> bool:
    """Choose the checkpoint to start with, if --resume is given. Return whether there is anything to train.

    UserError without a folder, and for a finished training that cannot be continued in this way.

    stops: `Part.ends_by` of all parts.
    """
    if not getattr(launch, "resume", False):
        return True
    folder = dataset.model_path or folder_of(launch.start_checkpoint)
    if not folder:
        raise UserError("--resume needs -m, the folder whose training it resumes or starts")
    asked = next((further for name, further in stops.items() if getattr(opt, name)), None)  # None: by --iterations
    if end := read_end(folder):
        launch.start_checkpoint = str(end.checkpoint)
        return _may_continue(folder, end, end.iteration < opt.iterations if asked is None else asked, asked is None)
    most = opt.iterations if asked is None else math.inf
    launch.start_checkpoint = newest_checkpoint(folder, most, since=0) or launch.start_checkpoint
    if not launch.start_checkpoint and saves_in(Path(folder)) and not read_model_json(folder):
        raise UserError(f"{folder} has a model, and no checkpoint to continue; leave --resume out to start over")
    return True


class End(NamedTuple):
    """The end of a training: its last iteration, the option that continues it, and the checkpoint that it leaves."""

    iteration: int
    more: str
    checkpoint: Path


def read_end(folder: str | os.PathLike) -> End | None:
    """Read the end of the training in a model folder; None if the training has not reached it.

    The checkpoint may not exist.
    """
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
    """Return a line that says how to continue a training from its last checkpoint."""
    size = f"{path.stat().st_size / 1e6:.3g} MB"
    return f"Last checkpoint: {shlex.quote(str(path))} ({size}); --resume with {more} continues this training"


def _may_continue(folder: str, end: End, asked: bool, by_iterations: bool) -> bool:
    """Tell whether to continue a folder's finished training. UserError if it is impossible, or not by --iterations."""
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
