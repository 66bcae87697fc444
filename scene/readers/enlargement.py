"""Enlargement of scenes whose unit is small: the rasterizer draws nothing nearer than NEAREST.

Such a scene is trained, saved and shown in its own unit. Only where it is drawn, cameras and Gaussians are larger by a
power of two, which changes no digit of float32: then depths from NEAREST over the enlargement on are drawn.
"""

import numpy as np

from scene.readers.info import NEAREST, CameraInfo, SceneInfo, as_camera_info
from scene.readers.tracks import projected

NEAR_SHARE = 0.01  # of the points in view; usual scenes have none nearer than NEAREST, and one with 0.026 lost 2.5 dB
_USUAL = 2.0  # depth that all but NEAR_SHARE of the points in view have in usual scenes: 2.2 to 3.6 in nine
_CAMERAS = 16  # whose depths are looked at
_SAMPLE = 5000  # points


def enlargement(info: SceneInfo) -> float:
    """A power of two by which a scene is enlarged where it is drawn; 1 where at most a few points are too near."""
    depths = _depths(info)
    usual = float(np.quantile(depths, NEAR_SHARE)) if len(depths) else NEAREST
    return 1.0 if usual >= NEAREST else float(2.0 ** np.ceil(np.log2(_USUAL / usual)))


def _depths(info: SceneInfo) -> np.ndarray:
    """Depths of points, each in each photo that shows it; of a lens that is taken as it is, distances."""
    if info.point_cloud is None:
        return np.zeros(0)
    points = np.asarray(info.point_cloud.points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]  # a training refuses the others
    sample, views = points[:: -(-len(points) // _SAMPLE) or 1], info.train_cameras
    return np.concatenate([_of_view(as_camera_info(view), sample) for view in views[:: -(-len(views) // _CAMERAS)]])


def _of_view(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    local = points @ view.R + view.T
    depths = np.linalg.norm(local, axis=1) if view.native else local[:, 2]
    return depths[projected(view, points)[2] & (depths > 0)]
