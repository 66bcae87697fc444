"""Saves of the model as PLY, checkpoints that a training can be resumed from, and the space that they need."""

import math
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scene.gaussians.checkpoint import save_checkpoint
from splatting.part import Error, Part
from splatting.training.folder import view_command
from splatting.training.iteration import Iteration, Losses
from splatting.training.trim_report import TrimReport, lines, saved_line
from utils.system_utils import UserError, saved_ply

if TYPE_CHECKING:
    from splatting.training.run import Run


class Saves(Part):
    """Saves the PLY when planned. The last save leaves out what the model does not need, and says so at the end."""

    def __init__(self, run: "Run") -> None:
        self._run = run
        self._left_out: TrimReport | None = None

    def due(self, step: Iteration) -> bool:
        return step.takes(self._run.launch.save_iterations)

    def measured(self, step: Iteration, losses: Losses) -> None:
        if not step.takes(self._run.launch.save_iterations):
            return
        run = self._run
        step.record = step.record or {}
        with run.clock.paused("saving"):
            run.gaussians.check_finite(step.iteration)
            tqdm.write(f"[ITER {step.iteration}] Saving Gaussians", file=sys.stdout)
            if step.last:
                # Then the test photos are in memory, and scoring them once more costs little.
                scored = step.scored_at is not None or run.opt.iterations in run.launch.test_iterations
                self._left_out = run.save_last(step.iteration, scored)
                step.record |= {"gaussians_left_out": self._left_out.unseen}
                return
            count = run.gaussians.gaussian_count
            if run.group.first and (text := little_space(run, count, count, step.iteration)):
                tqdm.write(f"warning: {text}", file=sys.stderr)
            run.scene.save(step.iteration)

    def ended(self, error: Error) -> None:
        if error is None and self._left_out is not None:
            run = self._run
            folder = saved_ply(run.scene.model_path, self._left_out.iterations).parent
            run.log.tell(saved_line(self._left_out, folder))
            run.log.keep(*lines(self._left_out))


class Checkpoints(Part):
    """Writes chkpntN.pth when planned, and when a signal stops the training, which also saves the PLY."""

    def __init__(self, run: "Run") -> None:
        self._run = run

    def due(self, step: Iteration) -> bool:
        return step.takes(self._run.launch.checkpoint_iterations)

    def stepped(self, step: Iteration) -> None:
        if step.stopping or step.takes(self._run.launch.checkpoint_iterations):
            self.save(step)

    def save(self, step: Iteration, name: str = "") -> None:
        """Write a checkpoint after an iteration that is due, and say how to resume if the training stops.

        name: of the file, chkpntN.pth if it is empty.
        """
        run = self._run
        run.watch.check(step.iteration)
        path = write_checkpoint(run, step.iteration, name, with_ply=bool(step.stopping))
        if step.stopping:
            look = f"Look at the model: {view_command(run.scene.model_path, step.iteration)}"
            early = ", before its learning rates fell" if run.schedule.by_clock else ""
            resume = f"Resume by the same command with --start_checkpoint {path}"
            tqdm.write(f"Stopped at iteration {step.iteration}{early}\n{look}\n{resume}", file=sys.stderr)


def write_checkpoint(run: "Run", iteration: int, name: str = "", with_ply: bool = False) -> Path:
    """Write a checkpoint of the model, and its PLY, and note it in the log. Returns the checkpoint's path.

    Every rank must call it. name: of the file, chkpntN.pth if it is empty.
    """
    seconds = run.clock.seconds
    with run.clock.paused("saving"):
        run.gaussians.check_finite(iteration)
        tqdm.write(f"[ITER {iteration}] Saving Checkpoint", file=sys.stdout)
        path = Path(run.scene.model_path) / (name or f"chkpnt{iteration}.pth")
        run.scene.save_parts()
        save_checkpoint(path, run.checkpoint_state(), iteration)
        numbers = {"gaussians": run.gaussians.gaussian_count, "loss": run.losses.mean}
        run.log.add(iteration, seconds, run.clock.joules, **numbers)
        if with_ply:
            run.scene.save(iteration)
    return path


_OF_PLY = 3  # numbers of a Gaussian besides its own: normals, which are 0
_OF_CHECKPOINT = 3  # the same: statistics of density control. Its own come with Adam's two averages


def little_space(run: "Run", sure: int, later: int, first: int) -> str | None:
    """What to say if the saves from iteration `first` on do not fit with `later` Gaussians, before they are written.

    sure: Gaussians that there are at least. UserError if not even one PLY of so many fits.
    """
    folder = Path(run.scene.model_path).absolute()
    free = shutil.disk_usage(next(place for place in (folder, *folder.parents) if place.exists())).free
    values = sum(math.prod(attribute.shape) for attribute in run.gaussians._attributes.values())
    ply, checkpoint = 4 * (values + _OF_PLY), 4 * (3 * values + _OF_CHECKPOINT)
    if free < ply * sure:
        raise UserError(
            f"the disk of {folder} has {_mb(free)} free, and a model of {sure:,} Gaussians takes {_mb(ply * sure)}; "
            "free space there, or name another folder by -m"
        )
    planned = [run.schedule.known(one) for one in (run.launch.save_iterations, run.launch.checkpoint_iterations)]
    saves, checkpoints = (len({n for n in one if n >= first}) for one in planned)
    needed = later * (ply * max(saves, 1) + checkpoint * checkpoints)
    if free >= needed:
        return None
    return (
        f"the disk of {folder} has {_mb(free)} free, and the saves to come take about {_mb(needed)} if there are "
        f"{later:,} Gaussians; free space there in time"
    )


def _mb(count: float) -> str:
    return f"{count / 1e6:,.1f} MB"
