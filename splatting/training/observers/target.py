"""The end of a training whose test views are good enough (--target_psnr)."""

import sys

from tqdm import tqdm

from gaussian_renderer.scored_views import ScoredViews
from splatting.distributed.ranks import ranks
from splatting.training.objective import Losses
from splatting.training.observer import Error, Observer
from splatting.training.run import Run
from splatting.training.step import Step

EVERY = 100  # iterations between scorings, at least
PER_VIEW = 20  # iterations for each test view: to score one costs half of an iteration, so all cost some 2.5 %


class Target(Observer):
    """Scores all test views at fixed iterations, and ends the training with the one that reaches the target.

    The iterations follow from the number of views, so the same command ends with the same one, whatever the clock says.
    The model that was scored is the one that is saved. train_log.json gets the scores as `test_views_psnr`
    (gaussian_renderer/scored_views.py).
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._cameras = run.scene.getTestCameras()
        self._views = ScoredViews(run.pipe, run.background, run.dataset.train_test_exp)
        self._every = max(EVERY, PER_VIEW * len(self._cameras))
        self._psnr: float | None = None

    def due(self, step: Step) -> bool:
        return step.last or step.iteration % self._every == 0

    def measured(self, step: Step, losses: Losses) -> None:
        if not self.due(step):
            return
        run, target = self._run, self._run.opt.target_psnr
        with run.clock.paused("scoring"):
            run.scene.prefetch(self._cameras)
            self._psnr = ranks().shared(self._views.scores(self._cameras, run.gaussians).get("psnr"))
        if self._psnr is None:  # masks leave no pixel of the views
            return
        step.record = (step.record or {}) | {"test_views_psnr": self._psnr}
        if self._psnr >= target:
            tqdm.write(
                f"[ITER {step.iteration}] Test views have {self._psnr:.3f} dB, and --target_psnr is {target:g}",
                file=sys.stdout,
            )
            step.end(run.pace.length)

    def ended(self, error: Error) -> None:
        target = self._run.opt.target_psnr
        if error is None and not (self._psnr or 0.0) >= target:
            what = "have no pixel to score" if self._psnr is None else f"have {self._psnr:.3f} dB"
            self._run.log.tell(f"Test views {what}, and --target_psnr {target:g} was not reached")
