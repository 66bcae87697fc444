"""Records of scored and saved iterations in train_log.json."""

from training.objective import Losses
from training.observer import Observer
from training.run import Run
from training.step import Step


class Records(Observer):
    """Writes what other observers have put into the step's record, once all of it is there."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def measured(self, step: Step, losses: Losses) -> None:
        if step.record is None:
            return
        run, seconds = self._run, self._run.clock.seconds
        with run.clock.paused():
            run.log.add(step.iteration, seconds, gaussians=len(run.gaussians), loss=run.losses.mean, **step.record)
