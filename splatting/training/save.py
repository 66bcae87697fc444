"""Saves of the model as PLY, checkpoints that a training can be resumed from, and the space that they need."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scene.gaussians.checkpoint import save_checkpoint
from splatting.findings.resources import little_space
from splatting.part import Error, Part
from splatting.training.folder import view_command
from splatting.training.iteration import Iteration, Losses
from splatting.training.trim_report import TrimReport, lines, saved_line
from utils.system_utils import saved_ply

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
