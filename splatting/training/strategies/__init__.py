"""Strategies: how many Gaussians there are, and where. Each is a file, whose name is that of --strategy."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

import torch

from arguments.strategies import STRATEGIES
from scene.cameras import Camera
from scene.readers.start_cloud import RANDOM_POINTS
from scene.scene import Scene
from splatting.training.density import DensityControl
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.training.run import Run

AUTO, USUAL = "auto", "adc"
# By the clock `budget` is best, but mcmc with few photos and the time for 250 iterations of each on a GPU. See
# docs/guide/strategies.md.
FEW, SECONDS = 50, 0.25  # training photos; seconds for each


def of_clock(seconds: float, cameras: Sequence[Camera], device: torch.device) -> str:
    """The strategy that is best in so many seconds, which --strategy auto takes for a new run that has them."""
    few = len(cameras) <= FEW and seconds >= SECONDS * len(cameras)
    return "mcmc" if few and device.type == "cuda" else "budget"


def is_random(scene: Scene) -> bool:
    """Whether a scene has no points but random ones."""
    cloud = scene.info.point_cloud
    if cloud is None or scene.info.ply_path is not None or len(cloud.points) != RANDOM_POINTS:
        return False
    return bool((cloud.colors == cloud.colors[0]).all())


def density_control(run: "Run") -> DensityControl:
    """The strategy that --strategy names, for the model and the scene of a run: `of_run` of the file of that name.

    UserError for a name that is none of a strategy: a file of another run may say anything.
    """
    if (name := run.opt.strategy) not in STRATEGIES:
        raise UserError(f"there is no strategy {name!r}; give --strategy {' or '.join(STRATEGIES)}")
    control = import_module(f"{__name__}.{name}").of_run(run)
    control.random = is_random(run.scene)
    return control
