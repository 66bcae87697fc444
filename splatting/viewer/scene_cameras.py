"""The training and test cameras of a scene: their names on the page, and where they stand."""

import math
from collections.abc import Sequence

import numpy as np

from gaussian_renderer.free_view import rotation_matrix
from scene.cameras import Camera
from splatting.viewer.settings import Pose, Vector, as_utf8

_NEAR = 1e-3  # of the scene's size: a page's camera that close stands at the scene's camera
_TURNED = 2e-3  # radians
_MARGIN = 1.1  # of the scene's size, to the distance of the outermost camera


class SceneCameras:
    """by_name: the cameras, training ones first, with names such as `train 3: IMG_0007`."""

    def __init__(self, train: Sequence[Camera], test: Sequence[Camera]) -> None:
        from splatting.camera_paths.poses import focus_point, poses_of  # SciPy takes a while to import

        sets = {"train": train, "test": test}
        self.by_name: dict[str, Camera] = {
            as_utf8(f"{of_set} {index}: {camera.image_name}"): camera
            for of_set, cameras in sets.items()
            for index, camera in enumerate(cameras)
        }
        self._all = [*train, *test]
        centers = np.array([center(camera) for camera in self._all]).reshape(-1, 3)
        middle = centers.mean(0) if len(centers) else np.zeros(3)
        self._target, self._up = focus_point(poses_of(self._all)) if self._all else None, self.up()
        self.size = float(np.linalg.norm(centers - middle, axis=1).max(initial=0.0)) * _MARGIN or 1.0

    @property
    def first(self) -> Camera | None:
        """The camera in which the page begins."""
        return self._all[0] if self._all else None

    def up(self) -> Vector:
        """The mean upward direction of the cameras, unit length: photos are mostly taken upright."""
        total = -sum((camera.R[:, 1] for camera in self._all), np.zeros(3))
        length = np.linalg.norm(total)
        return tuple((total / length).tolist()) if length > 1e-6 else (0.0, -1.0, 0.0)

    def up_at(self, camera: Camera) -> Vector:
        """An upward direction with which a camera looks as its photo does, as near to that of all as can be.

        A browser turns around this direction, so that of a camera that looks down would tilt the horizon.
        """
        right, own, common = camera.R[:, 0], -camera.R[:, 1], np.asarray(self._up)
        upright = common - (common @ right) * right
        return tuple((upright if upright @ own > 0.05 else own).tolist())

    def depth(self, camera: Camera) -> float:
        """Distance of what a camera looks at: of the point nearest to all optical axes, if that is in front of it."""
        depth = 0.0 if self._target is None else float((self._target - center(camera)) @ camera.R[:, 2])
        return depth if depth > 0.1 * self.size else self.size

    def stands_at(self, pose: Pose, camera: Camera) -> bool:
        """Whether a page's camera has the place and the direction of a scene's camera."""
        apart = np.linalg.norm(np.asarray(pose.position) - center(camera))
        cosine = (np.trace(rotation_matrix(pose.wxyz).T @ camera.R) - 1) / 2
        return bool(apart <= _NEAR * self.size and math.acos(float(np.clip(cosine, -1, 1))) <= _TURNED)


def center(camera: Camera) -> np.ndarray:
    """Position (3,) float64 in the world."""
    return -camera.R @ camera.T


def canvas(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The smallest (width, height) of an aspect in which an image fits."""
    if width < aspect * height:
        return max(width, round(height * aspect)), height
    return width, max(height, round(width / aspect))


def fov_of_canvas(camera: Camera, aspect: float) -> float:
    """Vertical opening angle, radians, of a window of this aspect that shows all of a camera's image."""
    _, height = canvas(camera.image_width, camera.image_height, aspect)
    return 2 * math.atan(math.tan(camera.FoVy / 2) * height / camera.image_height)
