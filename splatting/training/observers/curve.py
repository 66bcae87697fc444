"""The curve of error against run time, recorded while the model trains."""

from collections.abc import Sequence
from pathlib import Path

from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from splatting.evaluation.curve_recorder import CurveRecorder, evenly_spread
from splatting.training.iteration import Iteration, Losses
from splatting.training.part import Error, Part
from splatting.training.run import Run
from utils.system_utils import saved_iterations


class Curve(Part):
    """Scores test views, and as many training views, in planned iterations; draws the curve at the end."""

    def __init__(self, run: Run) -> None:
        self._run = run
        test = run.scene.getTestCameras()
        trained = [camera for camera in run.scene.getTrainCameras() if camera.columns is None]  # in whole
        views = ScoredViews(run.pipe, run.background, run.dataset.train_test_exp)
        self._recorder = CurveRecorder(
            run.scene.model_path,
            run.rows,
            run.log,
            run.opt.iterations,
            run.launch.test_iterations,
            {"test": test, "train": evenly_spread(trained, len(test))},
            lambda cameras: self._load(cameras, views),
            lambda camera: views.scores([camera], run.gaussians),
            run.device,
            not run.schedule.paced,
        )
        self._due = False
        self._seconds = 0.0

    def _load(self, cameras: Sequence[Camera], views: ScoredViews) -> None:
        self._run.scene.prefetch(cameras)
        for camera in cameras:
            views.load(camera)

    def due(self, step: Iteration) -> bool:
        first = self._run.schedule.schedule_step(self._run.first_iteration)
        self._due = self._recorder.due(step.span, first, self._run.clock.seconds, self._run.schedule.expected)
        return self._due

    def measured(self, step: Iteration, losses: Losses) -> None:
        if self._due or step.last:
            self._seconds = step.scored_at = self._run.clock.seconds
            point = self._recorder.point(step.span) or step.span[-1]
            with self._run.clock.paused("scoring"):
                self._recorder.add(point, self._seconds, self._run.gaussians.gaussian_count, step.iteration)

    def ended(self, error: Error) -> None:
        if error is not None:
            self._recorder.abandon()
            return
        run = self._run
        there = saved_iterations(Path(run.scene.model_path) / "point_cloud")
        saved = {*run.schedule.known(run.launch.save_iterations)} & {*there}
        self._recorder.finish(self._seconds, saved, not run.schedule.paced)
