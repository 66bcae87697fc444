"""The hooks by which a strategy of density control acts on a training (strategies: splatting/parts)."""

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from scene.cameras import Camera
from scene.gaussians.penalty import NO_PENALTY
from scene.readers.start_cloud import RANDOM_POINTS
from scene.scene import Scene
from splatting.part import Strategy
from splatting.training.iteration import Iteration
from splatting.training.schedule import STEADY, Schedule
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.training.run import Run

PIXELS = 64  # training pixels of all views for each Gaussian of the default budget
FEWEST, MOST = 100_000, 1_000_000  # Gaussians of the default budget


class DensityControl:
    """Decides how many Gaussians there are. A strategy overrides these hooks, in a file of its own.

    fusable: whether it needs no gradient besides the statistics. Steps are then taken by training/steps/fused.py, which
    does not call `after_backward`. It asks `observes`, and in iterations that `changes` names it asks `replaced` and
    calls `before_step`. It counts only where the class itself says so: a subclass may want more. queues: whether
    `after_step` queues operators that change the model; it queues nothing else, unless the iteration is one that
    `changes` names. max_gaussians: how many it lets there be, 0: any number. penalty: a part of the loss besides the
    objective, of which steps add the gradients; no loss that is told has it.
    absolute_gradients: whether the statistics take the lengths of absolute gradients (Ye et al. 2024); for the whole
    run. clamps: whether the loss takes renders clamped to [0, 1], as the reference's does; then Gaussians brighter than
    white cost nothing before a white background. ends: the iteration of the schedule from which it changes no rows.
    schedule: tells how far it is in an iteration (training/schedule.py). Rules that are windows of the schedule ask it;
    rules that count steps take the iteration itself. random: whether the model began as random points, of which the
    clock may remove those that it cannot train. grows_to: whether it is meant to reach max_gaussians; not where nobody
    has given a number, with default_is_limit.
    """

    fusable: ClassVar[bool] = False
    queues: ClassVar[bool] = False
    max_gaussians = 0
    penalty = NO_PENALTY
    absolute_gradients = False
    clamps: ClassVar[bool] = True
    ends = math.inf
    schedule: Schedule = STEADY
    random = False
    grows_to: ClassVar[bool] = True
    default_is_limit: ClassVar[bool] = False

    def started(self) -> None:
        """Called before the first iteration of a model that was made from points, not read from a file."""

    def changes(self, iteration: int) -> bool:
        """Whether this iteration will change rows of the Gaussians besides their optimiser step.

        If so, every loss so far is checked first, because a change cannot be undone.
        """
        return False

    def observes(self, iteration: int) -> bool:
        """Whether the view of this iteration counts in the Gaussians' statistics, where the step is fused."""
        return False

    def recovers(self, iteration: int) -> bool:
        """Whether opacities were reset so recently that renders are not like photos."""
        return False

    def resets(self, iteration: int) -> bool:
        """Whether all opacities are reset in this iteration."""
        return False

    def replaced(self, iteration: int) -> Collection[str]:
        """Attributes that `before_step` will give other values or rows, so that they take no step in this iteration.

        Asked, where the step is fused, before anything of the iteration changes the model. Every rank must call it.
        """
        return ()

    def projected_count(self, count: int, first: int, last: int) -> int:
        """The most that `count` Gaussians can become from iteration `first` to `last`, both known to the schedule.

        `max_gaussians` where the strategy has no number to reach.
        """
        return self.max_gaussians

    def count_limit(self, iteration: int, count: int, limit: int) -> int:
        """How many Gaussians there may be after an iteration, 0: any number. limit: as an option has it, 0: none.

        With a time budget not more than so few iterations can train, but the `count` that are there all stay, except of
        a random start.
        """
        return self.schedule.count_limit(iteration, count, limit, self.random, self.max_gaussians)

    def too_slow(self) -> str:
        """Why it may not reach its number of Gaussians in time, and what to do."""
        return "they at most double each time; lower --densification_interval"

    def rate_factor(self, iteration: int) -> float | None:
        """Factor of the learning rates that have no schedule, where the run's schedule has none. None: 1."""
        return None

    def after_backward(self, step: Iteration, package: dict[str, Tensor]) -> None:
        """Called with the gradients computed, before the optimiser's step. package: the result of `render`."""
        self.before_step(step)

    def before_step(self, step: Iteration) -> None:
        """Change what `replaced` tells of, once the view counts in the statistics."""

    def after_step(self, step: Iteration) -> None:
        """Called after the optimiser's step, so not in the last iteration, which takes none."""


def density_control(run: "Run", strategy: Strategy) -> DensityControl:
    """The control of a strategy, for the model, the scene and the schedule of a run."""
    control = strategy.control(run)
    control.random, control.schedule = is_random(run.scene), run.schedule
    return control


def is_random(scene: Scene) -> bool:
    """Whether a scene has no points but random ones."""
    cloud = scene.info.point_cloud
    if cloud is None or scene.info.ply_path is not None or len(cloud.points) != RANDOM_POINTS:
        return False
    return bool((cloud.colors == cloud.colors[0]).all())


def default_budget(cameras: Sequence[Camera]) -> int:
    """The number of Gaussians to reach where --max_num_splats is 0: one for PIXELS pixels, from FEWEST to MOST."""
    pixels = sum(camera.image_width * camera.image_height for camera in cameras)
    return min(max(pixels // PIXELS, FEWEST), MOST)


def refuse_empty(iteration: int, is_empty: bool, remedy: str, what: str = "after the densification of") -> None:
    """UserError if a strategy has left no Gaussian."""
    if is_empty:
        raise UserError(
            f"no Gaussian was left {what} iteration {iteration}: the views do not agree with the points, or show "
            f"nothing but the background; check the scene, or {remedy}"
        )
