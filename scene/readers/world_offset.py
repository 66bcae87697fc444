"""Local frame of scenes whose coordinates are large compared with their extent, as in map projections (UTM).

float32 has steps of 0.06 at 1e6. Such a scene is trained as world minus an offset, computed and subtracted in double.
"""

from dataclasses import replace

import numpy as np

from scene.readers.info import CameraInfo, SceneInfo, normalization, scene_extent
from utils.graphics_utils import BasicPointCloud

# Extents from the origin. There a step of float32 is a hundred-thousandth of the extent, many times the moves of
# positions in the last iterations (1.6e-6 extents and less).
FARTHEST = 100.0


def world_offset(info: SceneInfo) -> np.ndarray:
    """Offset (3,) float64: round decimal numbers near a scene that is far from its origin, else zero."""
    cameras = info.train_cameras + info.test_cameras
    middle = np.median([camera.center for camera in cameras], axis=0)
    return origin_near(middle, scene_extent(cameras, None if info.point_cloud is None else info.point_cloud.points))


def origin_near(middle: np.ndarray, extent: float) -> np.ndarray:
    """Round decimal numbers (3,) near the middle of something of an extent, zero if that is not far away."""
    if np.abs(middle).max() <= FARTHEST * extent:
        return np.zeros(3)
    step = 10.0 ** np.ceil(np.log10(10 * extent))
    return np.round(middle / step) * step


def local(info: SceneInfo, offset: np.ndarray) -> SceneInfo:
    """The scene in the frame whose origin is `offset` (3,) of the world; its points become float32."""
    moved = bool(np.any(offset))
    train, test = info.train_cameras, info.test_cameras
    if moved:
        train, test = ([_moved(camera, offset) for camera in cameras] for cameras in (train, test))
    cloud, points = info.point_cloud, None
    if cloud is not None:
        with np.errstate(over="ignore"):  # the points become infinite, which start_rows refuses
            points = (cloud.points - offset if moved else cloud.points).astype(np.float32)
        cloud = BasicPointCloud(points, cloud.colors, cloud.normals)
    size = normalization(train, points)
    return replace(
        info, point_cloud=cloud, train_cameras=train, test_cameras=test, nerf_normalization=size, offset=offset
    )


def _moved(camera: CameraInfo, offset: np.ndarray) -> CameraInfo:
    return replace(camera, T=camera.T + camera.R.T @ offset)
