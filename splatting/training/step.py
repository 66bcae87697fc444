"""One iteration of training: what the loop, the losses, density control and the observers know of it."""

from collections.abc import Collection
from dataclasses import dataclass

from torch import Tensor

from scene.cameras import Camera


@dataclass(slots=True)
class Step:
    """One iteration, counted from 1. Run.steps makes it; only the fields `due` to `stopping` and its end change later.

    An observer that is asked before those that save may end the training with this iteration (`end`), in `measured`.
    """

    iteration: int
    last: bool  # nothing comes after it, so it takes no step
    camera: Camera
    background: Tensor  # (3,), random or that of the scene
    depth_weight: float  # of the depth loss, 0 if the view has no reliable depth map
    changes: bool  # rows of the Gaussians, the SH degree or the size of views change in this iteration
    started: float  # seconds of training before it
    due: bool = False  # the model is read, written or changed, so every loss so far must be checked first
    record: dict[str, float] | None = None  # what train_log.json gets of this iteration; None: no record
    scored_at: float | None = None  # seconds of training when the curve scored it, for all records of the same score
    stopping: type[KeyboardInterrupt] | None = None  # raised once the step is complete
    span: range = None  # iterations of the schedule that it stands for (splatting/training/schedule), itself by default

    def __post_init__(self) -> None:
        if self.span is None:
            self.span = range(self.iteration, self.iteration + 1)

    def takes(self, planned: Collection[int]) -> bool:
        """Whether what is planned for an iteration of the schedule is to be done in it."""
        return any(iteration in planned for iteration in self.span)

    def end(self, length: int) -> None:
        """Make it the last one; what is planned for the rest of the schedule, of a length, is done in it."""
        self.last, self.span = True, range(self.span.start, length + 1)
