"""Coarse to fine: views that are smaller at first, by how far the schedule is (--resolution_schedule)."""

from typing import TYPE_CHECKING, Any

from splatting.files.json_files import MODEL_JSON
from splatting.training.option import Option, one_of
from splatting.training.part import Error, Options, Part, fill
from utils.system_utils import UserError

if TYPE_CHECKING:
    import argparse

    from scene.scene import Scene


class CoarseToFine(Part):
    """Says which sizes are asked for, before a schedule decides on them, and gives the views these sizes."""

    name = "coarse_to_fine"
    switch = "resolution_schedule"
    # fmt: off
    options = Options(optimisation=(
        Option("resolution_schedule", "auto", origin="ours", check=one_of("auto", "none", "pyramid"),
            stored=MODEL_JSON, topic="quality and speed",
            help="train on smaller views at first, which takes less time. pyramid: a quarter of the size up to 10 % "
                 "of the schedule, half of it up to 25 %; auto: pyramid where a given time is short for the size of "
                 "the photos, else none"),
    ))
    # fmt: on
    _run = None

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    @classmethod
    def follows_length(cls, given: "argparse.Namespace") -> bool:
        return getattr(given, cls.switch, "none") != "none"

    def check(self, run: Any, state: Any) -> None:
        run.schedule.sizes = run.opt.resolution_schedule

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.coarse_to_fine.sizes import Sizes
        from splatting.training.schedule import PYRAMID

        schedule, asked = run.schedule, run.opt.resolution_schedule
        schedule.megapixels = run.scene.training_pixels()[0] / len(run.scene.getTrainCameras()) / 1e6
        if not schedule.paced:
            schedule.sizes = "none" if asked == "auto" else asked
            schedule.levels = PYRAMID if schedule.sizes == "pyramid" else ()
        elif asked not in ("auto", schedule.sizes):
            raise UserError(
                f"the schedule of this run already sets --resolution_schedule {schedule.sizes}; leave that option out"
            )
        self._run = run
        run.opt.resolution_schedule = schedule.sizes
        fill(run, "sizes", Sizes(schedule, run.scene.images), self)

    def changes(self, iteration: int) -> bool:
        step = self._run.schedule.schedule_step
        return self._run.sizes.factor_at(step(iteration - 1)) != self._run.sizes.factor_at(step(iteration))

    def save(self, scene: "Scene") -> None:
        """Keep the sizes that a clock has chosen by now."""
        if self._run and self._run.schedule.by_clock:
            from arguments import add_to_model_json

            add_to_model_json(scene.model_path, **self.facts())

    def ended(self, error: Error) -> None:
        self.save(self._run.scene)

    def facts(self) -> dict[str, Any]:
        return {self.switch: self._run.schedule.sizes}
