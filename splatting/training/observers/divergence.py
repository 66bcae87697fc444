"""Detects divergence without synchronising the device, saves the last good model and stops with one message."""

import math
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from scene.gaussians.adam import StepGuard
from scene.gaussians.checkpoint import save_checkpoint
from splatting.training.iteration import Iteration, Losses
from splatting.training.part import Error, Part
from splatting.training.run import Run
from utils.system_utils import UserError

_SHOWN = 5  # rows that a message names
_COMPARED = 10  # losses compared, at the start and at the end, each of a different view
_NEVER = 1 << 62  # an iteration
_WORSE_AFTER = 100  # iterations after which a loss should have fallen


class DivergenceWatch(Part):
    """Checks, when something is due, that all losses and all steps of the optimisers were finite.

    After the first one that was not, the optimisers change nothing (StepGuard), so even a late check finds the
    last good model.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._gaussians = run.gaussians
        self._ranks = run.group
        self._losses = run.losses
        self._iteration = run.first_iteration
        self._guard = StepGuard(run.device)
        run.gaussians.guard_steps(self._guard)
        self._sh_degrees = [run.gaussians.active_sh_degree] * 2  # in the last two iterations
        self._earliest: list[float] = []
        self._latest: deque[float] = deque(maxlen=_COMPARED)

    def measured(self, step: Iteration, losses: Losses) -> None:
        self._losses.add(step.iteration, losses.total)
        self._guard.watch(step.iteration, losses.total)
        self._sh_degrees = [self._sh_degrees[1], self._gaussians.active_sh_degree]
        if step.due:
            self.look(step.iteration)

    def look(self, iteration: int, stepped: bool = False) -> None:
        """Save a checkpoint and raise UserError if a loss or a step was not finite.

        Call it in every iteration that writes a file, changes the number of Gaussians, zeroes Adam's averages, or
        raises the SH degree. stepped: the iteration has taken its step.
        """
        losses = self._losses.read()
        self._earliest = [*self._earliest, *losses.values()][:_COMPARED]
        self._latest.extend(losses.values())
        self._iteration = iteration
        bad = next((t for t, loss in losses.items() if not math.isfinite(loss)), _NEVER)
        bad, stopped = self._ranks.numbers(bad, self._guard.stopped_in() or _NEVER).amin(0).tolist()
        if bad == stopped == _NEVER:
            return
        first = min(bad, stopped)
        if bad == first:
            # The guard held that iteration's step back, too.
            good, what = first - 1, f"the loss became {self._value_of(losses[first])}"
        else:
            good, what = first, f"{self._unstepped()} had no finite step"
        self._gaussians.rewind(iteration - good if stepped else iteration - 1 - good)
        self._run.stop_skipping(guarded=False)
        if good < iteration:
            self._gaussians.active_sh_degree = self._sh_degrees[0]
        view = self._run.views[first].image_name
        raise UserError(
            f"{what} in iteration {first} (view {view}), so training stopped; {self._rescue(good)}, or "
            "check this view and the point cloud"
        )

    def ended(self, error: Error) -> None:
        """Warn of a training whose loss is above what it began with."""
        if error is not None or self._run.first_iteration > 0 or self._iteration < _WORSE_AFTER:
            return
        before, after = (sum(losses) / len(losses) for losses in (self._earliest, self._latest))
        if after > before:
            tqdm.write(
                f"warning: the loss rose from {before:.3g} to {after:.3g}, so the model is worse than its start; lower "
                "the learning rates, or check poses and photos (doctor.py)",
                file=sys.stderr,
            )

    def _value_of(self, loss: float) -> float:
        """The loss of an iteration that was not finite, in whatever process."""
        return next((value for value in self._ranks.everyone(loss) if not math.isfinite(value)), loss)

    def _unstepped(self) -> str:
        parts = []
        for name, rows, count in self._gaussians.take_marks():
            more = ", ..." if len(rows) > _SHOWN else ""
            parts.append(f"{name} of {len(rows)} of {count} ({', '.join(map(str, rows[:_SHOWN]))}{more})")
        return " and ".join(parts)

    def _rescue(self, iteration: int) -> str:
        """Save the model, all processes together. Return what was saved, and what to do."""
        if iteration == self._run.first_iteration:
            return "there is no earlier model to save; lower the learning rates"
        path = Path(self._run.scene.model_path) / f"chkpnt{iteration}.pth"
        faults = self._ranks.everyone(self._fault(lambda: self._gaussians.check_finite(iteration)))
        fault = next(filter(None, faults), None)
        if fault is None:
            self._gaussians.drop_broken_statistics()
            state = self._gaussians.capture()
            fault = self._ranks.shared(self._fault(lambda: save_checkpoint(path, state, iteration)))
        if fault is not None:
            return f"and the model could not be saved ({fault}); resume an earlier checkpoint"
        return (
            f"the last good model, after iteration {iteration}, is saved: resume with --start_checkpoint {path} and "
            "lower learning rates"
        )

    @staticmethod
    def _fault(call: Callable[[], object]) -> str | None:
        try:
            call()
        except UserError as error:
            return str(error)
        return None
