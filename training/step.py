"""One iteration of training: what the loop, the losses, density control and the observers know of it."""

from dataclasses import dataclass

from torch import Tensor

from scene.cameras import Camera


@dataclass(slots=True)
class Step:
    """One iteration, counted from 1. The loop makes it; only `due` and `stopping` change on the way."""

    iteration: int
    last: bool
    camera: Camera
    background: Tensor  # (3,), random or that of the scene
    depth_weight: float  # of the depth loss, 0 where the view has no depth map that is trusted
    changes: bool  # density control will change the Gaussians in this iteration
    started: float  # seconds of training before it
    due: bool = False  # something is written or changed, so every loss so far must be checked first
    stopping: type[KeyboardInterrupt] | None = None  # raised once the step is complete
