"""One iteration of training: what the loop, the losses, density control and the observers know of it."""

from dataclasses import dataclass

from torch import Tensor

from scene.cameras import Camera


@dataclass(slots=True)
class Step:
    """One iteration, counted from 1. Run.steps makes it; only `due`, `record` and `stopping` change later."""

    iteration: int
    last: bool
    camera: Camera
    background: Tensor  # (3,), random or that of the scene
    depth_weight: float  # of the depth loss, 0 if the view has no reliable depth map
    changes: bool  # rows of the Gaussians or the SH degree will change in this iteration
    started: float  # seconds of training before it
    due: bool = False  # the model is read, written or changed, so every loss so far must be checked first
    record: dict[str, float] | None = None  # what train_log.json gets of this iteration; None: no record
    stopping: type[KeyboardInterrupt] | None = None  # raised once the step is complete
