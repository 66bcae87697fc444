"""Output of a training: the progress bar, train_log.json, and the lines that are printed and noted at the end."""

import math
import time

from groundwork.host.clock import wall_seconds
from groundwork.host.progress import Bar
from splatting.checks import STRATEGY, check_overfitting
from splatting.folder import view_command
from splatting.iteration import Iteration, Losses
from splatting.objective import LossWatch
from splatting.part import Error, Part
from splatting.records.error_curve import whole_sets
from splatting.run import Run

# Without a rate: that of the schedule is not that of iterations.
BY_CLOCK = "{l_bar}{bar}| [{elapsed}<{remaining}{postfix}]"
BAR_INTERVAL = 10  # iterations between updates, at least
BAR_SECONDS = 0.2  # between updates, at least: each reads the losses, and so waits for the GPU


class ProgressBar(Part):
    """Shows running means of the loss and of the parts' terms, and prints at the end how long the training took."""

    def __init__(self, run: Run) -> None:
        """Show a bar of the schedule's steps, those done before the run included."""
        self._run = run
        self._shown = {"Loss": run.losses}
        self._updated, self._done = -math.inf, run.first_iteration
        first = run.schedule.step_before(run.first_iteration)
        form = {"bar_format": BY_CLOCK} if run.schedule.by_clock else {}
        self._bar = Bar(initial=first, total=run.schedule.length, desc="Training progress", dynamic_ncols=True, **form)

    def due(self, at: Iteration) -> bool:
        shown = at.iteration % BAR_INTERVAL == 0 and time.monotonic() - self._updated >= BAR_SECONDS
        at.due |= at.last or shown
        return False  # it reads losses, and not the model, whose blocks may sleep on

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Keep the losses, and show their means in an iteration that is due, in which the GPU is waited for anyway."""
        for name, term in losses.terms.items():
            self._shown.setdefault(f"{name.capitalize()} Loss", LossWatch()).add(at.iteration, term)
        if not at.due:
            return
        for loss in self._shown.values():
            loss.read()
        means = {name: f"{loss.mean:.7f}" for name, loss in self._shown.items()}
        if at.span.stop - 1 != at.iteration:  # the bar counts iterations of the schedule
            means["Iterations"] = f"{at.iteration:,}"
        # As text: tqdm would round the number to three digits.
        self._bar.set_postfix(means, Gaussians=f"{self._run.gaussians.gaussian_count:,}", refresh=False)
        self._bar.update(at.span.stop - 1 - self._bar.n)
        self._updated, self._done = time.monotonic(), at.iteration

    def ended(self, error: Error) -> None:
        """Close the bar and, without an error, print the number of iterations and their seconds."""
        self._bar.close()
        if error is not None:
            return
        run, seconds = self._run, self._run.clock.seconds
        if not run.schedule.by_clock:
            before = f", {run.log.seconds_before + seconds:.1f} s with those before" if run.first_iteration else ""
            print(f"{_format_iterations(self._done - run.first_iteration)} in {seconds:.1f} s{before}")
            return
        # With those before a resume, as the budget.
        seconds, whole = run.log.seconds_before + seconds, run.log.wall_seconds_before + wall_seconds()
        budget = f"budget {run.schedule.until:.4g} s, {whole:.1f} s with start, scores and saves"
        run.log.tell(f"{_format_iterations(self._done)} in {seconds:.1f} s ({budget})")


def _format_iterations(count: int) -> str:
    return f"{count:,} iteration{'s' if count != 1 else ''}"


class Summary(Part):
    """Prints at the end the model's score, and the command that shows the model."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._psnr: float | None = None
        self._iteration = run.first_iteration

    def measured(self, at: Iteration, losses: Losses) -> None:
        self._iteration = at.iteration
        if at.last:
            scored = [row["test_psnr"] for row in whole_sets(self._run.rows) if row["iteration"] == at.iteration]
            self._psnr = scored[0] if scored else None

    def ended(self, error: Error) -> None:
        """Print the model's score and the command that shows the model, unless an error ended the training."""
        if error is not None:
            return
        run = self._run
        scored = "" if self._psnr is None else f"Test PSNR {self._psnr:.2f} dB (as metrics.py). "
        print(f"{scored}Look at the model: {view_command(run.scene.model_path, self._iteration)}")


class Records(Part):
    """Writes an iteration's record, once all other observers have put their numbers into it.

    Numbers of parts are also recorded at points of the curve.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._seconds = 0.0

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Write the record of an iteration that other observers or the curve have put numbers into."""
        run = self._run
        if at.record is None and at.scored_at is None:
            return
        added = {name: number for part in run.parts for name, number in part.records().items()}
        if at.record is None and not added:
            return
        self._seconds = seconds = run.clock.seconds if at.scored_at is None else at.scored_at
        with run.clock.paused("saving"):
            values = (at.record or {}) | added
            values |= {"gaussians": run.gaussians.gaussian_count, "loss": run.losses.mean}
            run.log.add(at.iteration, seconds, run.clock.joules, **values)

    def ended(self, error: Error) -> None:
        """Note the strategy, signs of overfitting, and the seconds of this process by their purpose."""
        if error is not None:
            return
        run, log = self._run, self._run.log
        log.note(**{STRATEGY: run.opt.strategy})
        log.keep(*run.warnings)
        log.advise(*map(str, check_overfitting(run.rows, log.records)))
        first, spent = run.first_done, run.clock.spent
        seconds = max(self._seconds, log.records[-1]["seconds"] - log.seconds_before)  # perhaps of a later checkpoint
        parts = {"training": seconds, "scoring": 0.0, "saving": 0.0} | spent
        log.note(
            first_iteration_seconds=None if first is None else round(first, 3),
            **{f"{part}_seconds": round(seconds, 3) for part, seconds in parts.items()},
        )
