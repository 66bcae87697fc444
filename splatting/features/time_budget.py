"""Trainings that end after given seconds (--time_budget), or take as many iterations as another run (--schedule)."""

import argparse
import sys
from pathlib import Path
from typing import Any

import torch

from groundwork.files.json_files import SCHEDULE
from groundwork.host.memory import free_memory
from groundwork.ranks.ranks import ranks
from scene.gaussians.density_rules import band_rate
from scene.images.store import GPU_SHARE, ImageStore
from scene.scene import Scene
from scene.view import View
from splatting.features.time_budget_file import schedule_of, table_of, write_schedule
from splatting.features.time_budget_schedule import AN_ITERATION, SHORT, DecidedSchedule
from splatting.iteration import Iteration
from splatting.part import Part
from splatting.schedule import Schedule

LEAST = 32  # pixels of the shorter side of a view; a picture is not made smaller than that


class TimeBudget(Part):
    """Lets each iteration stand for a part of the schedule, and records the parts in schedule.json.

    Where the time is short for the size of the photos, views are smaller at first.
    """

    name = "time_budget"
    _iteration = 0  # of a run; a scene without one saves no schedule
    ends_by = {"time_budget": True, "schedule": False}

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        return next((f"--{name}" for name in cls.ends_by if getattr(given, name, None)), "")

    @classmethod
    def joins_by_state(cls, given: argparse.Namespace, iteration: int) -> bool:
        """Print a warning that this run continues by --iterations, not by the checkpoint's schedule; return False."""
        print(
            f"warning: {given.start_checkpoint} was trained with --time_budget or --schedule; this run has neither and "
            f"continues at iteration {iteration} of --iterations {given.iterations}",
            file=sys.stderr,
        )
        return False

    def make_schedule(
        self, opt: argparse.Namespace, checkpoint: str | None, first_iteration: int, state: Any
    ) -> Schedule:
        self._schedule = schedule_of(opt, checkpoint, first_iteration, ranks().broadcast_object, state)
        return self._schedule

    def begin(self, run: Any, state: Any) -> None:
        """Tell the schedule about photos, points and device, and let it choose the size of views."""
        schedule, cameras = run.schedule, run.scene.getTrainCameras()
        schedule.random = run.scene.info.has_random_points
        schedule.short = SHORT[run.device.type]
        schedule.megapixels = run.scene.training_pixels()[0] / len(cameras) / 1e6
        if run.device.type == "cuda":
            schedule.an_iteration = AN_ITERATION * max(band_rate(cameras), 1.0)
        run.sizes = Sizes(schedule, run.scene.images)

    def measured(self, at: Iteration, losses: object) -> None:
        self._iteration = at.iteration

    def state(self) -> dict[str, Any] | None:
        return table_of(self._schedule.decided) if self._schedule.blocks else None

    def save(self, scene: Scene) -> None:
        if self._iteration:
            write_schedule(Path(scene.model_path) / SCHEDULE, self._schedule.up_to(self._iteration))


class Sizes:
    """Gives the training views the size that their place in the schedule asks for.

    A smaller view is made when it is first needed, and kept while its level lasts. The smaller photos take 1 /
    factor**2 of the memory of the photos, in addition. Where that is too much for a GPU, or where --images_to_load
    limits the images, smaller views are made again each time. Views of other classes, or with assigned pictures, keep
    their size.

    factor: factor of the last view.
    """

    def __init__(self, schedule: DecidedSchedule, images: ImageStore) -> None:
        """Begin with views in their own size.

        schedule: schedule that tells the factor of sizes at each of its steps.
        images: store of the photos, whose size tells whether smaller views can be kept.
        """
        self.factor = 1.0
        self._schedule = schedule
        self._images = images
        self._made: dict[View, View] = {}
        self._keeps = True

    def factor_at(self, schedule_step: int) -> float:
        """Return the factor at an iteration of the schedule."""
        return self._schedule.factor_at(schedule_step)

    def smallest(self, camera: View) -> tuple[int, int]:
        """Return the smallest size (width, height) in which a view may train."""
        return smaller(camera, max((factor for _, factor in self._schedule.possible_levels), default=1.0))

    def view(self, camera: View, schedule_step: int) -> View:
        """Return a view in its size at an iteration of the schedule. Call this in ascending order of iterations."""
        factor = self.factor_at(schedule_step)
        if factor != self.factor:
            self._change_factor(factor)
        if not self._shrinks(camera):
            return camera
        found = self._made.get(camera)
        if found is None:
            found = camera.at_size(smaller(camera, factor))
            if self._keeps:
                self._made[camera] = found
        return found

    def needs(self, camera: View) -> bool:
        """Tell whether the pictures of a view will be needed in their own size."""
        return camera not in self._made

    def _shrinks(self, camera: View) -> bool:
        if self.factor == 1 or not isinstance(camera, View) or not camera.has_dataset_pictures:
            return False
        return smaller(camera, self.factor) != (camera.image_width, camera.image_height)

    def _change_factor(self, factor: float) -> None:
        """Forget the smaller views so far, and decide whether those of a new factor are kept."""
        self.factor = factor
        self._made.clear()
        free = free_memory(torch.device(self._images.device))
        room = free is None or self._images.planned_bytes / factor / factor <= GPU_SHARE * free
        # Ranks that share pictures make the smaller ones together.
        self._keeps = not self._images.ranks.any_rank(self._images.limit > 0 or not room)


def smaller(camera: View, factor: float) -> tuple[int, int]:
    """Return the size (width, height) of a view with sides divided by a factor, or by less if the view is small."""
    sides = camera.image_width, camera.image_height
    factor = max(1.0, min(factor, min(sides) / LEAST))
    return tuple(max(1, round(side / factor)) for side in sides)
