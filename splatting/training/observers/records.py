"""Records of scored and saved iterations in train_log.json, and where the process spent its time."""

from splatting.training.objective import Losses
from splatting.training.observer import Error, Observer
from splatting.training.run import Run
from splatting.training.step import Step


class Records(Observer):
    """Writes what other observers have put into the step's record, once all of it is there."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._seconds = 0.0

    def measured(self, step: Step, losses: Losses) -> None:
        if step.record is None:
            return
        run = self._run
        self._seconds = seconds = run.clock.seconds if step.scored_at is None else step.scored_at
        with run.clock.paused("saving"):
            run.log.add(step.iteration, seconds, gaussians=run.gaussians.total, loss=run.losses.mean, **step.record)

    def ended(self, error: Error) -> None:
        """Note the seconds of this process: up to its first iteration, of training, of scoring and of saving."""
        if error is not None:
            return
        first, spent = self._run.first_done, self._run.clock.spent
        parts = {"training": self._seconds, "scoring": 0.0, "saving": 0.0} | spent
        self._run.log.note(
            first_iteration_seconds=None if first is None else round(first, 3),
            **{f"{part}_seconds": round(seconds, 3) for part, seconds in parts.items()},
        )
