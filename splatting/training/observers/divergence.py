"""Ends a training at the first loss or step that is not finite, without synchronising the device in each iteration."""

import math
import sys
from collections import deque

from tqdm import tqdm

from scene.gaussians.adam import StepGuard
from splatting.part import Error, Part
from splatting.training.iteration import Iteration, Losses
from splatting.training.observers.saves import write_checkpoint
from splatting.training.run import Run
from utils.system_utils import UserError

_COMPARED = 10  # losses compared, at the start and at the end, each of a different view
_NEVER = 1 << 62  # an iteration
_WORSE_AFTER = 100  # iterations after which a loss should have fallen


class DivergenceWatch(Part):
    """Asks, when something is due, whether all losses and all steps of the optimisers were finite.

    After the first one that was not, the optimisers change nothing (StepGuard), so that even a late answer finds the
    model as it was.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._losses = run, run.losses
        self._iteration = run.first_iteration
        self._guard = StepGuard(run.device)
        run.gaussians.guard_steps(self._guard)
        self._earliest: list[float] = []
        self._latest: deque[float] = deque(maxlen=_COMPARED)

    def measured(self, step: Iteration, losses: Losses) -> None:
        self._losses.add(step.iteration, losses.total)
        self._guard.watch(step.iteration, losses.total)
        if step.due:
            self.look(step.iteration)

    def look(self, iteration: int) -> None:
        """Save the model with a checkpoint, and raise UserError, if a loss or a step was not finite.

        Call it in every iteration that writes a file, changes the number of Gaussians, zeroes Adam's averages, or
        raises the SH degree.
        """
        losses = self._losses.read()
        self._earliest = [*self._earliest, *losses.values()][:_COMPARED]
        self._latest.extend(losses.values())
        self._iteration = iteration
        bad = next((t for t, loss in losses.items() if not math.isfinite(loss)), _NEVER)
        bad, stopped = self._run.group.numbers(bad, self._guard.stopped_in() or _NEVER).amin(0).tolist()
        first = min(bad, stopped)
        if first == _NEVER:
            return
        # With its loss, the whole step of an iteration is held back; else only that of the values that had none.
        what, good = ("the loss", first - 1) if bad == first else ("a step", first)
        view = self._run.views[first].image_name
        raise UserError(
            f"{what} of iteration {first} (view {view}) is not finite, so training stopped; "
            f"{self._saved(good, iteration)}, or check this view and the point cloud"
        )

    def _saved(self, good: int, iteration: int) -> str:
        """Save the model after the iteration `good`, as it still is. Returns what was saved, and what to do."""
        run = self._run
        if good == run.first_iteration:
            return "nothing was trained before; lower the learning rates"
        run.gaussians.drop_held_steps(max(iteration - 1 - good, 0))
        self._guard.stopped.zero_()  # sleeping blocks take the steps that they have missed
        run.stop_skipping()
        path = write_checkpoint(run, good, with_ply=True)
        return f"the model is saved: resume with --start_checkpoint {path} and lower learning rates"

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
