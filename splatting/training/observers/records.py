"""Records of train_log.json, and what it notes at the end of a training."""

from splatting.evaluation.what_to_try import BUDGET, CAP, PLANNED, STRATEGY, what_to_try
from splatting.part import Error, Part, overrides
from splatting.training.density import default_budget
from splatting.training.iteration import Iteration, Losses
from splatting.training.run import Run


class Records(Part):
    """Writes what other observers have put into the step's record, once all of it is there.

    What parts add is also recorded at points of the curve.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._seconds = 0.0

    def measured(self, step: Iteration, losses: Losses) -> None:
        run = self._run
        if step.record is None and step.scored_at is None:
            return
        added = {name: number for add in overrides(run.parts, "records") for name, number in add().items()}
        if step.record is None and not added:
            return
        self._seconds = seconds = run.clock.seconds if step.scored_at is None else step.scored_at
        with run.clock.paused("saving"):
            values = (step.record or {}) | added
            values |= {"gaussians": run.gaussians.gaussian_count, "loss": run.losses.mean}
            run.log.add(step.iteration, seconds, run.clock.joules, **values)

    def ended(self, error: Error) -> None:
        """Note how the training was planned, what to try next, and the seconds of this process by their purpose."""
        if error is not None:
            return
        run, log, opt = self._run, self._run.log, self._run.opt
        options = {PLANNED: opt.iterations, STRATEGY: opt.strategy}
        if not run.density.grows_to:
            budget = default_budget(run.scene.getTrainCameras())
            options |= {CAP: opt.max_num_splats} if opt.max_num_splats else {BUDGET: budget}
        log.note(**options)
        log.keep(*run.warnings)
        log.advise(*what_to_try(run.rows, log.records))
        first, spent = run.first_done, run.clock.spent
        seconds = max(self._seconds, log.records[-1]["seconds"] - log.seconds_before)  # perhaps of a later checkpoint
        parts = {"training": seconds, "scoring": 0.0, "saving": 0.0} | spent
        log.note(
            first_iteration_seconds=None if first is None else round(first, 3),
            **{f"{part}_seconds": round(seconds, 3) for part, seconds in parts.items()},
        )
