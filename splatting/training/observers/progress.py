"""The progress bar: losses and the number of Gaussians."""

import math
import time

from tqdm import tqdm

from splatting.training.loss_watch import LossWatch
from splatting.training.objective import Losses
from splatting.training.observer import Error, Observer
from splatting.training.run import Run
from splatting.training.step import Step

BAR_INTERVAL = 10  # iterations between updates, at least
BAR_SECONDS = 0.2  # between updates, at least: each reads the losses, and so waits for the GPU


class ProgressBar(Observer):
    """Shows running means. At the end of a training it says how long that took."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._depth = LossWatch()
        self._shown = {"Loss": run.losses} | ({"Depth Loss": self._depth} if run.dataset.depths else {})
        self._updated, self._done = -math.inf, run.first_iteration
        first = run.pace.nominal(run.first_iteration)
        self._bar = tqdm(initial=first, total=run.pace.length, desc="Training progress", dynamic_ncols=True)

    def due(self, step: Step) -> bool:
        shown = step.iteration % BAR_INTERVAL == 0 and time.monotonic() - self._updated >= BAR_SECONDS
        return step.last or shown

    def measured(self, step: Step, losses: Losses) -> None:
        if losses.depth is not None:
            self._depth.add(step.iteration, losses.depth)
        if not step.due:
            return
        for loss in self._shown.values():
            loss.read()
        means = {name: f"{loss.mean:.7f}" for name, loss in self._shown.items()}
        if step.span.stop - 1 != step.iteration:  # the bar counts iterations of the schedule
            means["Iterations"] = f"{step.iteration:,}"
        # As text: tqdm would round the number to three digits.
        self._bar.set_postfix(means, Gaussians=f"{self._run.gaussians.total:,}", refresh=False)
        self._bar.update(step.span.stop - 1 - self._bar.n)
        self._updated, self._done = time.monotonic(), step.iteration

    def ended(self, error: Error) -> None:
        self._bar.close()
        if error is None:
            count = self._done - self._run.first_iteration
            print(f"Trained {count} iterations in {self._run.clock.seconds:.1f} s, without tests and saving")
