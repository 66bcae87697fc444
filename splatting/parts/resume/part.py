"""Trainings that are resumed by the command that began them (--resume), and last checkpoints, to train further from."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatting.option import MOST_NEEDED, Option
from splatting.part import Error, Options, Part

if TYPE_CHECKING:
    import argparse

    from splatting.training.iteration import Iteration

LEAST = 60.0  # seconds of training between two checkpoints
SHARE = 0.01  # of the seconds of training, which checkpoints take at most
EVERY = 50  # iterations: several processes exchange whether a checkpoint is due, which takes time in each
_BYTES = 720  # of a Gaussian with 59 numbers: each with two averages of Adam, and three statistics
_SPEED = 2e8  # bytes that a disk writes in a second, until it has shown how many


class Resume(Part):
    """With --resume, writes a checkpoint from time to time. Leaves one at the end, and notes that it was reached."""

    name = "resume"
    tools = ("prepare",)
    waits = True  # after the checkpoints that were asked for
    # fmt: off
    options = Options(launch=(
        Option("resume", False, origin="ours", topic=MOST_NEEDED,
            help="resume in -m, or start there, and write checkpoints for the next --resume"),
        Option("no_last_checkpoint", False, origin="ours", called=True, topic="output",
            help="leave no checkpoint at the end. It has 720 MB for a million Gaussians, and --resume continues it "
                 "with more --iterations or seconds"),
    ))
    # fmt: on

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    def ready(self, run: Any) -> None:
        """Say what this training does to that of its folder, once nothing can refuse it."""
        from splatting.parts.resume.end import finished

        folder = run.dataset.model_path
        if run.start is None and run.group.first and (there := finished(folder)):
            instead = f"; --resume with {there.more} would continue it" if there.checkpoint.is_file() else ""
            print(
                f"warning: {folder} has a finished training of {there.iteration:,} iterations, and this one starts "
                f"over{instead}",
                file=sys.stderr,
            )

    def opened(self, run: Any) -> None:
        from splatting.training.folder import REPLACED

        self._run, self._file = run, Path(run.scene.model_path) / REPLACED
        self._before = self._spent = 0.0  # seconds of training at the last checkpoint, seconds of writing so far
        self._speed = _SPEED
        self._is_due = False
        if run.start is None and run.group.first:
            self._file.unlink(missing_ok=True)

    def due(self, at: "Iteration") -> bool:
        launch = self._run.launch
        asked = launch.resume and not at.last and at.iteration % EVERY == 0
        self._is_due = asked and self._run.group.shared(self._has_time())
        return self._is_due or self._leaves(at)

    def _has_time(self) -> bool:
        seconds = self._run.clock.seconds
        wanted = self._spent + _BYTES * self._run.gaussians.gaussian_count / self._speed
        return seconds >= self._before + LEAST and wanted <= SHARE * seconds

    def _leaves(self, at: "Iteration") -> bool:
        """Whether the iteration is the last, and leaves a checkpoint."""
        launch = self._run.launch
        return at.last and not launch.no_last_checkpoint and not at.takes(launch.checkpoint_iterations)

    def stepped(self, at: "Iteration") -> None:
        if at.stopping:
            return
        if self._leaves(at):
            self._save(at)
        elif self._is_due:
            begun = time.monotonic()
            self._save(at, self._file.name)
            taken = max(time.monotonic() - begun, 1e-3)
            self._spent += taken
            self._speed = _BYTES * self._run.gaussians.gaussian_count / taken
            self._before = self._run.clock.seconds
        if at.last:
            self._tell(Path(self._run.scene.model_path) / f"chkpnt{at.iteration}.pth")

    def _tell(self, last: Path) -> None:
        from tqdm import tqdm

        from splatting.parts.resume.end import checkpoint_line

        if self._run.group.first and last.is_file():
            tqdm.write(checkpoint_line(last, self._run.schedule.more), file=sys.stdout)

    def _save(self, at: "Iteration", name: str = "") -> None:
        """Write a checkpoint. A disk that is full is told, and ends nothing: nobody has asked for this file."""
        from tqdm import tqdm

        from utils.system_utils import UserError

        try:
            self._run.checkpoints.save(at, name)
        except UserError as error:
            if not isinstance(error.__cause__, OSError):  # such as a loss that is not finite
                raise
            tqdm.write(f"warning: {error}", file=sys.stderr)

    def ended(self, error: Error) -> None:
        from splatting.parts.resume.end import note_finished

        if error is None and self._run.group.first:
            note_finished(self._run)
            self._file.unlink(missing_ok=True)
