"""Saves: the model as PLY, checkpoints from which a training can be resumed, and warnings where the disk gets full."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scene.gaussians.checkpoint import save_checkpoint
from splatting.folder import view_command
from splatting.iteration import Iteration, Losses
from splatting.part import Error, Part
from splatting.resources import little_space
from splatting.trim_report import TrimReport, lines, saved_line
from utils.system_utils import saved_ply

if TYPE_CHECKING:
    from splatting.run import Run


class Saves(Part):
    """Saves the PLY when planned. The last save leaves out what the model does not need, and a line says so."""

    def __init__(self, run: "Run") -> None:
        self._run = run
        self._left_out: TrimReport | None = None

    def due(self, at: Iteration) -> bool:
        return at.takes(self._run.launch.save_iterations)

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Save the PLY in a planned iteration; in the last one without what the model does not need."""
        if not at.takes(self._run.launch.save_iterations):
            return
        run = self._run
        at.record = at.record or {}
        with run.clock.paused("saving"):
            run.gaussians.check_finite(at.iteration)
            tqdm.write(f"[ITER {at.iteration}] Saving Gaussians", file=sys.stdout)
            if at.last:
                # Then the test photos are in memory, and scoring them once more costs little.
                scored = at.scored_at is not None or run.opt.iterations in run.launch.test_iterations
                self._left_out = run.save_last(at.iteration, scored)
                at.record |= {"gaussians_left_out": self._left_out.unseen}
                return
            count = run.gaussians.gaussian_count
            if run.group.first and (text := little_space(run, count, count, at.iteration)):
                tqdm.write(f"warning: {text}", file=sys.stderr)
            run.scene.save(at.iteration)

    def ended(self, error: Error) -> None:
        """Print and log what the last save holds and lacks, if there was one."""
        if error is None and self._left_out is not None:
            run = self._run
            folder = saved_ply(run.scene.model_path, self._left_out.iterations).parent
            run.log.tell(saved_line(self._left_out, folder))
            run.log.keep(*lines(self._left_out))


class Checkpoints(Part):
    """Writes chkpntN.pth when planned, and when a signal stops the training, which also saves the PLY."""

    def __init__(self, run: "Run") -> None:
        self._run = run

    def due(self, at: Iteration) -> bool:
        return at.takes(self._run.launch.checkpoint_iterations)

    def stepped(self, at: Iteration) -> None:
        if at.stopping or at.takes(self._run.launch.checkpoint_iterations):
            self.save(at)

    def save(self, at: Iteration, name: str = "") -> None:
        """Write a checkpoint after an iteration that is due, and print how to resume if the training stops here.

        name: file name, chkpntN.pth if it is empty.
        """
        run = self._run
        run.watch.check(at.iteration)
        path = write_checkpoint(run, at.iteration, name, with_ply=bool(at.stopping))
        if at.stopping:
            look = f"Look at the model: {view_command(run.scene.model_path, at.iteration)}"
            early = ", before its learning rates fell" if run.schedule.by_clock else ""
            resume = f"Resume by the same command with --start_checkpoint {path}"
            tqdm.write(f"Stopped at iteration {at.iteration}{early}\n{look}\n{resume}", file=sys.stderr)


def write_checkpoint(run: "Run", iteration: int, name: str = "", with_ply: bool = False) -> Path:
    """Write a checkpoint of the model, and note it in the log. Return the path of the checkpoint.

    Every rank must call it.

    name: file name, chkpntN.pth if it is empty.
    with_ply: true to save the PLY, too.
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
