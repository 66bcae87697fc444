"""An iteration of training, with its view and its losses, as the loop, the loss, density control and parts know it."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor

from groundwork.deterministic.counter_rng import Stream, permutation
from scene.cameras import Camera
from scene.gaussians.density_rules import Actions
from utils.system_utils import UserError

# Scalar of a render's package and of the mask of the pixels that count, (1, H, W) bool or None.
Term = Callable[[dict[str, Any], Tensor | None], Tensor]


class Losses(NamedTuple):
    """Scalars of one iteration, and the mask that they were computed with."""

    total: Tensor  # what is differentiated
    l1: Tensor  # of the colours
    terms: dict[str, Tensor]  # parts of the total that were added to the photometric loss, weighted, by name
    mask: Tensor | None  # (1, H, W) bool, pixels that count; None if all do

    def detached(self) -> "Losses":
        """Return the values alone, which keep neither an image nor its gradient."""
        terms = {name: value.detach() for name, value in self.terms.items()}
        return Losses(self.total.detach(), self.l1.detach(), terms, self.mask)


@dataclass(slots=True)
class Iteration:
    """An iteration, counted from 1. `Run.iterations` makes it; the last fields are set while it runs."""

    iteration: int
    last: bool  # nothing comes after it, so it takes no step
    camera: Camera
    background: Tensor  # (3,), random or that of the scene
    changes: bool  # rows of the Gaussians, the SH degree or the size of views may change
    started: float  # seconds of training before it
    span: range  # steps of the schedule that it stands for (splatting/schedule.py); of the last, all that are left
    density: Actions = Actions()  # what density control does in it
    rests: bool = False  # an earlier run ended with it, and took no step
    terms: dict[str, Term] = field(default_factory=dict)  # that parts add to the loss, weights included
    captured: bool = True  # a captured step may record the terms
    wants_depth: bool = False  # its loss needs the rendered depth
    due: bool = False  # the model is read, written or changed, so every loss so far must be checked first
    read: bool = False  # an observer reads the model
    record: dict[str, float] | None = None  # what train_log.json gets of this iteration; None: no record
    scored_at: float | None = None  # seconds of training when the curve scored it, for all records of the same score
    stopping: type[KeyboardInterrupt] | KeyboardInterrupt | None = None  # raised once the step is complete

    @property
    def steps(self) -> bool:
        """True if the iteration takes a step."""
        return not (self.last or self.rests)

    def takes(self, planned: Collection[int]) -> bool:
        """Tell whether this iteration is to do what is planned for certain iterations of the schedule.

        planned: iterations of the schedule.
        """
        return any(iteration in planned for iteration in self.span)


class OwnSize:
    """The default of the slot run.sizes: all views have their own size in all iterations."""

    factor = 1.0  # by which the last view was made smaller

    def factor_at(self, schedule_step: int) -> float:
        """Return the factor at an iteration of the schedule."""
        return 1.0

    def view(self, camera: Camera, schedule_step: int) -> Camera:
        """Return a view in the size in which it is trained at an iteration of the schedule."""
        return camera

    def needs(self, camera: Camera) -> bool:
        """Tell whether the pictures of a view will be needed in their own size."""
        return True

    def smallest(self, camera: Camera) -> tuple[int, int]:
        """Return the smallest size (width, height) in which a view may train."""
        return camera.image_width, camera.image_height


class ViewOrder:
    """Training cameras by iteration, counted from 1: each once per epoch, in an order drawn from seed and epoch."""

    def __init__(self, cameras: list[Camera], seed: int) -> None:
        """Prepare the order. UserError without cameras.

        seed: seed from which the order of each epoch is drawn.
        """
        if not cameras:
            raise UserError("the scene has no training views; without --eval all views train")
        self.cameras = cameras
        self.seed = seed
        self._orders: dict[int, list[int]] = {}

    def __getitem__(self, iteration: int) -> Camera:
        """Return the camera of an iteration, counted from 1."""
        epoch, position = divmod(iteration - 1, len(self.cameras))
        if epoch not in self._orders:
            # Two at most: prefetching at the end of an epoch alternates between it and the next.
            order = permutation(self.seed, Stream.VIEW_ORDER, epoch, len(self.cameras))
            self._orders = {epoch: order} | {e: o for e, o in self._orders.items() if e == epoch - 1}
        return self.cameras[self._orders[epoch][position]]

    def coming(self, iteration: int, count: int) -> list[Camera]:
        """Return the cameras of `count` iterations from this one on; at most one epoch of them."""
        return [self[t] for t in range(iteration, iteration + min(count, len(self.cameras)))]
