"""The record that every camera is made of."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scene.images.in_memory import InMemory
from scene.images.masks import Mask
from scene.images.store import Size, Source
from utils.graphics_utils import rigid_pose


@dataclass
class View:
    """One view at training size.

    size: (width, height) in pixels. source: the photo. mask: of the pixels that count, None: all do. ignore_alpha:
    transparent pixels do not count. depth: inverse depth, 1 / world units. depth_reliable: train on it. columns: those
    that count in loss and scores (scene/half_images.py), None: all. offset: principal point minus image centre in NDC.
    R, T: without a scale (`utils.graphics_utils.rigid_pose`). trans, scale: as `world_to_camera` takes them.
    data_device: of the pictures, as --data_device. The rest: as the attributes of scene.cameras.Camera.
    """

    uid: int
    colmap_id: int
    R: np.ndarray
    T: np.ndarray
    FoVx: float
    FoVy: float
    image_name: str
    size: Size
    source: Source | InMemory
    image_path: Path | None = None
    mask: Mask | None = None
    ignore_alpha: bool = False
    depth: Source | InMemory | None = None
    depth_reliable: bool = False
    columns: slice | None = None
    offset: tuple[float, float] = (0.0, 0.0)
    trans: np.ndarray = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0
    data_device: str = "cuda"

    def __post_init__(self) -> None:
        self.R, self.T = rigid_pose(self.R, self.T, self.image_name)


def half(width: int, of_test_view: bool) -> slice:
    """Columns of the half that counts in the half-image protocol: the right one of test views, else the left one."""
    return slice(width // 2, width) if of_test_view else slice(0, width // 2)
