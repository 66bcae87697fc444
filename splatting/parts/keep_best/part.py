"""The last save is the model that showed validation views best (--keep_best)."""

from typing import TYPE_CHECKING, Any

from splatting.files.json_files import MODEL_JSON
from splatting.training.option import Option
from splatting.training.part import Error, Needs, Options, Part

if TYPE_CHECKING:
    import argparse

    from scene.readers.info import SceneInfo
    from splatting.training.iteration import Iteration, Losses


class KeepBest(Part):
    """Takes views away from training, scores them in the curve's iterations, and keeps the best model so far."""

    name = "keep_best"
    tools = "remarks", "against_overfitting"
    # fmt: off
    options = Options(model=(
        Option("keep_best", False, origin="ours", stored=MODEL_JSON, topic="quality and speed",
            help="hold out every 16th training photo, and at least two, for validation; the last save is the model "
                 "with the best scores on them"),
    ))
    # fmt: on
    needs = Needs(ranks=False)
    against = {"needs.photos": "which trains more than Gaussians; leave one of them out"}

    def dataset(self, info: "SceneInfo", args: "argparse.Namespace", fresh: bool) -> "SceneInfo":
        from splatting.parts.keep_best.validation import without_validation

        return info if getattr(args, "other_scene", "") else without_validation(info)

    def begin(self, run: Any, state: Any) -> None:
        from gaussian_renderer.scored_views import ScoredViews
        from splatting.evaluation.curve_recorder import curve_points
        from splatting.parts.keep_best.best_model import BestModel

        self._run = run
        self.best = BestModel(run.scene.validation_cameras[1.0])
        if run.start:
            self.best.restore(state, run.gaussians)
        self._views = ScoredViews(run.pipe, run.background, False)
        whole, length = run.launch.test_iterations, run.opt.iterations
        self._points = curve_points(length, whole, 1, len(self.best.cameras))[0] | {*whole, length}
        self._psnr: float | None = None

    def due(self, at: "Iteration") -> bool:
        return at.takes(self._points)

    def measured(self, at: "Iteration", losses: "Losses") -> None:
        if not at.takes(self._points):
            return
        run, best = self._run, self.best
        with run.clock.paused("scoring"):
            run.scene.prefetch(best.cameras)
            self._psnr = self._views.scores(best.cameras, run.gaussians).get("psnr")
            if self._psnr is not None:  # masks may leave no pixel of the views, or all are shown exactly
                best.offer(run.gaussians, at.iteration, self._psnr)
                at.record = (at.record or {}) | {"validation_psnr": self._psnr}

    def final(self, model: Any, iteration: int) -> tuple[Any, int]:
        return self.best.model(model, iteration), self.best.iteration or iteration

    def facts(self) -> dict[str, Any]:
        return {"kept_best": self.best.facts()}

    def state(self) -> dict[str, Any]:
        return self.best.captured()

    def ended(self, error: Error) -> None:
        if error is None:
            self._run.log.note(kept_iteration=self.best.iteration)
            self._run.log.tell(self.best.line(self._psnr))
