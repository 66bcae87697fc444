"""The curve of error against run time, recorded while the model trains: error_vs_time.csv and .png."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from splatting.iteration import Iteration, Losses
from splatting.part import Error, Part
from splatting.records.curve_recorder import CurveRecorder, evenly_spread
from utils.system_utils import saved_iterations


class Curve(Part):
    """Scores test views, and as many training views, in planned iterations, and draws the curve at the end."""

    def __init__(self, run: Any) -> None:
        """Make the recorder: it scores the test views, and as many training views that train in whole."""
        self._run, test = run, run.scene.getTestCameras()
        trained = [camera for camera in run.scene.getTrainCameras() if camera.columns is None]  # in whole
        views = ScoredViews(run.pipe, run.background, run.scene.halves)
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

    def due(self, at: Iteration) -> bool:
        run = self._run
        first = run.schedule.step_before(run.first_iteration)
        self._due = self._recorder.due(at.span, first, run.clock.seconds, run.schedule.expected)
        return self._due

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Score the views and add a point to the curve, in a planned iteration and in the last one."""
        if self._due or at.last:
            self._seconds = at.scored_at = self._run.clock.seconds
            point = self._recorder.point(at.span) or at.span[-1]
            with self._run.clock.paused("scoring"):
                self._recorder.add(point, self._seconds, self._run.gaussians.gaussian_count, at.iteration)

    def ended(self, error: Error) -> None:
        """Wait for the figure, and advise on the best iteration. After an error, end the process that draws."""
        if error is not None:
            self._recorder.abandon()
            return
        run = self._run
        there = saved_iterations(Path(run.scene.model_path) / "point_cloud")
        saved = {*run.schedule.known(run.launch.save_iterations)} & {*there}
        self._recorder.finish(self._seconds, saved, not run.schedule.paced)
