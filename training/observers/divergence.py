"""A training that diverges ends in a sentence, with the last good model saved, and costs no wait for the device."""

import math
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import StepGuard
from scene.gaussians.checkpoint import save_checkpoint
from training.observers.losses import LossWatch
from utils.system_utils import UserError

_SHOWN = 5  # rows that are named
_COMPARED = 10  # losses of the start and of the end, each of another view
_WORSE_AFTER = 100  # iterations that a loss is given to fall


class DivergenceWatch:
    """Looks now and then for a loss, or a step of the optimisers, that was not finite.

    From that iteration on the optimisers leave everything as it is (StepGuard), so however late somebody looks, the
    model is the last good one. losses: takes them all; name_of: the view of an iteration.
    """

    def __init__(
        self,
        gaussians: GaussianModel,
        losses: LossWatch,
        model_path: str,
        first_iteration: int,
        name_of: Callable[[int], str],
    ) -> None:
        self._gaussians = gaussians
        self._losses = losses
        self._folder = Path(model_path)
        self._first = self._iteration = first_iteration
        self._name_of = name_of
        self._guard = StepGuard(gaussians.get_xyz.device)
        gaussians.guard_steps(self._guard)
        self._sh_degrees = [gaussians.active_sh_degree] * 2  # in the last iteration but one, and in the last
        self._earliest: list[float] = []
        self._latest: deque[float] = deque(maxlen=_COMPARED)

    def note(self, iteration: int, loss: Tensor) -> None:
        """The loss of an iteration, before its step."""
        self._losses.add(iteration, loss)
        self._guard.watch(iteration, loss)
        self._sh_degrees = [self._sh_degrees[1], self._gaussians.active_sh_degree]

    def look(self, iteration: int, stepped: bool = False) -> None:
        """UserError, after saving a checkpoint, where a loss was not finite, or a step.

        To be called in every iteration that writes something, changes the number of Gaussians, zeroes moments, or
        raises the SH degree. stepped: it has taken its step.
        """
        losses = self._losses.read()
        self._earliest = [*self._earliest, *losses.values()][:_COMPARED]
        self._latest.extend(losses.values())
        self._iteration = iteration
        bad = next((t for t, loss in losses.items() if not math.isfinite(loss)), math.inf)
        stopped = self._guard.stopped_in() or math.inf
        if bad == stopped == math.inf:
            return
        first = int(min(bad, stopped))
        if bad == first:
            # The guard knew: nothing was stepped in that iteration either.
            good, what = first - 1, f"the loss became {losses[first]}"
        else:
            good, what = first, f"{self._unstepped()} could take no finite step"
        self._gaussians.rewind(iteration - good if stepped else iteration - 1 - good)
        if good < iteration:
            self._gaussians.active_sh_degree = self._sh_degrees[0]
        raise UserError(
            f"{what} in iteration {first} (view {self._name_of(first)}), so training stopped; {self._rescue(good)}, or "
            "check this view and the point cloud"
        )

    def finish(self) -> None:
        """At the end: a word on a training whose loss is above what it began with."""
        if self._first > 0 or self._iteration < _WORSE_AFTER:
            return
        before, after = (sum(losses) / len(losses) for losses in (self._earliest, self._latest))
        if after > before:
            print(
                f"warning: the loss was {before:.3g} at first and is {after:.3g} at the end, the model is worse than "
                "the points it began with; lower the learning rates, or look at poses and pictures (doctor.py)",
                file=sys.stderr,
            )

    def _unstepped(self) -> str:
        parts = []
        for name, rows, count in self._gaussians.take_marks():
            more = ", ..." if len(rows) > _SHOWN else ""
            parts.append(f"{name} of {len(rows)} of {count} ({', '.join(map(str, rows[:_SHOWN]))}{more})")
        return " and ".join(parts)

    def _rescue(self, iteration: int) -> str:
        if iteration == self._first:
            return "nothing was trained before; lower the learning rates"
        path = self._folder / f"chkpnt{iteration}.pth"
        try:
            self._gaussians.check_finite(iteration)
            self._gaussians.drop_broken_statistics()
            save_checkpoint(path, self._gaussians.capture(), iteration)
        except UserError as error:
            return f"and the model could not be saved ({error}); go on from an earlier checkpoint"
        return (
            f"the last good model, after iteration {iteration}, is saved: go on with --start_checkpoint {path} and "
            "lower learning rates"
        )
