"""Plain records that readers of datasets return. Nothing here decodes photos, uses a GPU or writes a file."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scene.pictures.masks import Mask
from scene.pictures.store import Decodable
from utils.graphics_utils import BasicPointCloud, focal2fov
from utils.system_utils import UserError

HOLD = 8  # every 8th photo by name is a test view (Mip-NeRF 360's split)
NEAREST = 0.2  # depth from which Gaussians are drawn (the rasterizer's rule)
APART = 10.0  # median distances from the cameras' median, beyond which a camera stands apart
NARROW = 1e-2  # of the depth; with a smaller E, removing Gaussians wider than 0.1 E would leave only pixel-sized ones
ROUNDING = 1e-9  # distances below this part of the scene are rounding errors


@dataclass(frozen=True)
class CameraInfo:
    """One view.

    uid: COLMAP's camera (intrinsics) id, or the frame's index. R (3,3): camera-to-world rotation; T (3,):
    world-to-camera translation. fx, fy, cx, cy in pixels of an image of width x height (pixel centres at .5).
    image_name: COLMAP's full name, or the file's stem. file_size: (width, height) of the photo. mask: of the photo's
    shape, None if all pixels count. ignore_alpha: transparent pixels of the photo do not count. depth: inverse depth of
    a training view that has a map (scene/readers/depth_maps.py).
    """

    uid: int
    R: np.ndarray
    T: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    image_path: Path
    image_name: str
    file_size: tuple[int, int]
    mask: Mask | None = None
    ignore_alpha: bool = False
    depth: Decodable | None = None

    @property
    def FovX(self) -> float:
        """Horizontal opening angle in radians of a frustum of the image's width."""
        return focal2fov(self.fx, self.width)

    @property
    def FovY(self) -> float:
        """Vertical opening angle in radians of a frustum of the image's height."""
        return focal2fov(self.fy, self.height)

    @property
    def center(self) -> np.ndarray:
        """Camera centre (3,) in the world."""
        return -self.R @ self.T


@dataclass(frozen=True)
class SceneInfo:
    """A dataset: start cloud (None if not wanted), views, extent E in world units, and the cloud's PLY if it has one.

    offset (3,) float64: the world's coordinates of the frame's origin (scene/readers/world_offset.py).
    """

    point_cloud: BasicPointCloud | None
    train_cameras: list[CameraInfo]
    test_cameras: list[CameraInfo]
    extent: float
    ply_path: Path | None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))


def split_by_order(
    cameras: list[CameraInfo], hold_out: bool, folder: Path
) -> tuple[list[CameraInfo], list[CameraInfo]]:
    """Training and test views: with hold_out every HOLD-th view, the first included, is a test view."""
    train = [camera for index, camera in enumerate(cameras) if not hold_out or index % HOLD]
    test = [camera for index, camera in enumerate(cameras) if hold_out and index % HOLD == 0]
    if not train:
        raise UserError(f"{folder} has too few photos for --eval, which holds out every {HOLD}th; leave --eval out")
    return train, test


def exposure_names(cameras: Sequence[CameraInfo]) -> list[str]:
    """A unique name for each view: its image name, or its path from the views' common folder if several share the name,
    as Blender's train/r_0 and test/r_0 do.
    """
    counts = Counter(camera.image_name for camera in cameras)
    folder = os.path.commonpath([camera.image_path.parent for camera in cameras]) if cameras else ""
    paths = [Path(os.path.relpath(camera.image_path, folder)).as_posix() for camera in cameras]
    return [c.image_name if counts[c.image_name] == 1 else path for c, path in zip(cameras, paths, strict=True)]


def scene_extent(cameras: list[CameraInfo], points: np.ndarray | None = None) -> float:
    """Extent E: 1.1 times the largest distance of a camera from the cameras' mean, in world units.

    Cameras that stand apart (`standing_apart`) are left out. If the cameras are nearly in one place (E below NARROW
    times the depth), E is 1.1 times the median depth of the points (N,3) in front of the first camera. Without such
    points it is then 1.
    """
    centers = np.array([camera.center for camera in cameras])
    counted = ~standing_apart(centers)
    centers, first = centers[counted], cameras[counted.argmax()]
    extent = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    points = np.zeros((0, 3)) if points is None else points
    depths = (points @ first.R + first.T)[:, 2]
    depths = depths[depths > 0]
    if not len(depths):
        return extent if extent > ROUNDING * (1 + np.abs(centers).max()) else 1.0
    fallback = 1.1 * float(np.median(depths))
    return extent if extent > NARROW * fallback else fallback


def standing_apart(centers: np.ndarray) -> np.ndarray:
    """Whether a camera centre of (N,3) is more than APART times the median distance from their median: (N,) bool."""
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    median = float(np.median(distances))
    # If most cameras are in one place, up to rounding, the others are no mistake.
    return distances > (APART * median if median > ROUNDING * distances.max() else np.inf)
