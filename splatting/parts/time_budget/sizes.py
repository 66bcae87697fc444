"""Coarse to fine: views that are smaller at first, by how far the schedule is."""

import torch

from scene.images.store import GPU_SHARE, ImageStore
from scene.view import View
from splatting.host.memory import free_memory
from splatting.parts.time_budget.paced import DecidedSchedule

LEAST = 32  # pixels of the shorter side; a picture is not made smaller than that


class Sizes:
    """Gives the views of training in the size that their place in the schedule asks for.

    A smaller view is made when it is first needed, and kept while its level lasts. The smaller photos take 1 /
    factor**2 of the memory of the photos, besides these. Where that is too much for a GPU, or where --images_to_load
    limits the images, they are made again each time. Views of other classes, or with assigned pictures, keep their
    size. factor: of the last view.
    """

    def __init__(self, schedule: DecidedSchedule, images: ImageStore) -> None:
        self.factor = 1.0
        self._schedule = schedule
        self._images = images
        self._made: dict[View, View] = {}
        self._keeps = True

    def factor_at(self, schedule_step: int) -> float:
        """The factor at an iteration of the schedule."""
        return self._schedule.factor_at(schedule_step)

    def smallest(self, camera: View) -> tuple[int, int]:
        """The smallest size (width, height) in which a view may train."""
        return smaller(camera, max((factor for _, factor in self._schedule.possible_levels), default=1.0))

    def view(self, camera: View, schedule_step: int) -> View:
        """A view as it is trained at an iteration of the schedule. Ask in ascending order."""
        factor = self.factor_at(schedule_step)
        if factor != self.factor:
            self._begin(factor)
        if not self._shrinks(camera):
            return camera
        found = self._made.get(camera)
        if found is None:
            found = camera.at_size(smaller(camera, factor))
            if self._keeps:
                self._made[camera] = found
        return found

    def needs(self, camera: View) -> bool:
        """Whether the pictures of a view will be needed in their own size."""
        return camera not in self._made

    def _shrinks(self, camera: View) -> bool:
        if self.factor == 1 or not isinstance(camera, View) or not camera.has_dataset_pictures:
            return False
        return smaller(camera, self.factor) != (camera.image_width, camera.image_height)

    def _begin(self, factor: float) -> None:
        self.factor = factor
        self._made.clear()
        free = free_memory(torch.device(self._images.device))
        room = free is None or self._images.planned_bytes / factor / factor <= GPU_SHARE * free
        # Ranks that share pictures make the smaller ones together.
        self._keeps = not self._images.ranks.anyone(self._images.limit > 0 or not room)


def smaller(camera: View, factor: float) -> tuple[int, int]:
    """Size (width, height) of a view whose sides are divided by a factor, or by less if it is small."""
    sides = camera.image_width, camera.image_height
    factor = max(1.0, min(factor, min(sides) / LEAST))
    return tuple(max(1, round(side / factor)) for side in sides)
