"""Contents of a frame: its settings, the pose of a browser's camera, which is checked, and the scene's cameras."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gaussian_renderer.camera_paths.poses import focus_point, look_along, poses_of, unit, vertical_fov
from gaussian_renderer.camera_paths.start import best_start
from gaussian_renderer.free_view import rotation_matrix
from groundwork.host.listing import as_utf8
from scene.cameras import Camera
from scene.readers.info import up_of
from utils.graphics_utils import camera_center

if TYPE_CHECKING:
    import viser

COLOUR, DEPTH, OPACITY, COUNT, ERROR = MODES = ("Colour", "Depth", "Opacity", "Gaussians per pixel", "Error")
WHOLE, STAYS, GOES = CLEANINGS = ("Whole model", "What stays", "What goes")
ALONE, SLIDER, BESIDE = COMPARISONS = ("Render alone", "Slider", "Side by side")

Vector = tuple[float, float, float]
_WIDEST = 8192  # pixels of a window's side
_SLIMMEST = 10  # ratio of its sides
_NEAR = 1e-3  # of the scene's size: a page's camera that close stands at the scene's camera
_TURNED = 2e-3  # radians
_MARGIN = 1.1  # of the scene's size, to the distance of the outermost camera
_ABOVE = math.radians(35)  # by which a view of all cameras looks down
_OF_ALL = math.radians(50)  # its vertical opening angle
_FILLED = 0.8  # of the window, at most, by the cameras


@dataclass(frozen=True)
class Pose:
    """A camera of the page and the size of its window.

    position: world. wxyz: unit quaternion, camera axes (x right, y down, z forward) to world. fov: vertical, radians.
    """

    position: Vector
    wxyz: tuple[float, float, float, float]
    fov: float
    width: int
    height: int


@dataclass(frozen=True)
class Settings:
    """mode: of MODES. darken: what no training view has shown. scaling: factor of all scales.

    sh_degree: highest that is drawn. background: RGB in [0, 1]. crop: opposite corners of the box outside of which
    nothing is drawn, world coordinates, or None. cleaning: of CLEANINGS. camera: name of the chosen camera, None: none.
    comparison: of COMPARISONS. slider: share of the width that is the scene's image.
    """

    mode: str = COLOUR
    darken: bool = False
    scaling: float = 1.0
    sh_degree: int = 3
    background: Vector = (0.0, 0.0, 0.0)
    crop: tuple[Vector, Vector] | None = None
    cleaning: str = WHOLE
    camera: str | None = None
    comparison: str = ALONE
    slider: float = 0.5


def read_pose(camera: "viser.CameraHandle") -> Pose | None:
    """The pose and window of a browser's camera, whose numbers are finite (auth.py); None if it cannot be drawn."""
    position, wxyz = [float(x) for x in camera.position], [float(x) for x in camera.wxyz]
    fov, length = float(camera.fov), math.hypot(*wxyz)
    if not 0 < fov < math.pi or not 1e-6 < length < 1e6:
        return None
    return Pose(tuple(position), tuple(x / length for x in wxyz), fov, *read_window(camera))


def read_window(camera: "viser.CameraHandle") -> tuple[int, int]:
    """Width and height, in pixels, of a browser's window; sides that cannot be drawn count as the nearest that can."""
    width, height = (min(max(int(side), 1), _WIDEST) for side in (camera.image_width, camera.image_height))
    return max(width, height // _SLIMMEST), max(height, width // _SLIMMEST)


class SceneCameras:
    """by_name: the cameras, training ones first, with names such as `train 3: IMG_0007`.

    start: the name of the one that a page begins at, as an exported page does; "" without any. up: their mean upward
    direction, unit length: images are mostly taken upright. vertical: that at right angles to their horizons. middle:
    of their places. size: of the scene.
    """

    def __init__(self, train: Sequence[Camera], test: Sequence[Camera]) -> None:
        """Index the cameras of the training and the test set, and find start, middle and size of the scene."""
        self.by_name: dict[str, Camera] = {
            as_utf8(f"{of_set} {index}: {camera.image_name}"): camera
            for of_set, cameras in (("train", train), ("test", test))
            for index, camera in enumerate(cameras)
        }
        self.start, self._target, self.up, self.size = "", None, np.array([0.0, -1.0, 0.0]), 1.0
        self._places, self.middle, self.vertical = np.zeros((0, 3)), np.zeros(3), self.up
        if self.by_name:
            poses = poses_of([*train, *test])
            self.start = list(self.by_name)[best_start(poses_of(train or test))]
            self._places, self.middle = poses.positions, poses.positions.mean(axis=0)
            self._target = focus_point(poses)
            self.up = unit(poses.up) if np.linalg.norm(poses.up) > 1e-6 else self.up
            self.vertical = up_of(poses.turns)
            offsets = poses.positions - self.middle
            self.size = float(np.linalg.norm(offsets, axis=1).max()) * _MARGIN or 1.0

    def up_at(self, axes: np.ndarray) -> Vector:
        """An upward direction with which a camera with these axes looks as its image does, near that of all.

        A browser turns around this direction, so that of a camera that looks down would tilt the horizon.
        """
        right, own = axes[:, 0], -axes[:, 1]
        upright = self.up - (self.up @ right) * right
        return tuple((upright if upright @ own > 0.05 else own).tolist())

    def target_of(self, place: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """The point that a camera looks at: as far away as the point nearest to all optical axes, if that is ahead."""
        ahead = 0.0
        if self._target is not None:
            ahead = float((self._target - place) @ axes[:, 2])
        return place + axes[:, 2] * (ahead if ahead > 0.1 * self.size else self.size)

    def move(self, client: "viser.ClientHandle", place: np.ndarray, axes: np.ndarray, fov: float) -> None:
        """Move a browser's camera. axes: to the world, as of a camera."""
        with client.atomic():
            with contextlib.suppress(ValueError):  # of a browser that says that it looks at its own place
                client.camera.position = place
            client.camera.look_at = self.target_of(place, axes)
            client.camera.up_direction = self.up_at(axes)
            client.camera.fov = fov

    def overview(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A place behind and above all cameras, its axes, and the point it looks at, so that `overview_fov` has all."""
        ahead, turn = np.zeros(3), np.asarray(self.by_name[self.start].R)
        for axis in (turn[:, 2], turn[:, 1]):  # the second one for a camera that looks straight down
            ahead = axis - (axis @ self.up) * self.up
            if np.linalg.norm(ahead) > 1e-3:
                break
        axes = look_along(math.cos(_ABOVE) * unit(ahead) - math.sin(_ABOVE) * self.up, self.up)
        inner = np.vstack([self._places] + ([] if self._target is None else [self._target])) @ axes
        middle = (inner.min(0) + inner.max(0)) / 2
        slope = _FILLED * math.tan(_OF_ALL / 2)
        away = (np.abs(inner - middle)[:, :2].max(1) / slope - (inner - middle)[:, 2]).max()
        target = axes @ middle
        return target - max(float(away), self.size) * axes[:, 2], axes, target

    def stands_at(self, pose: Pose, place: np.ndarray, axes: np.ndarray) -> bool:
        """Tell if a page's camera stands at a place and looks in a direction."""
        apart = np.linalg.norm(np.asarray(pose.position) - place)
        cosine = (np.trace(rotation_matrix(pose.wxyz).T @ axes) - 1) / 2
        return bool(apart <= _NEAR * self.size and math.acos(float(np.clip(cosine, -1, 1))) <= _TURNED)

    def stands_at_camera(self, pose: Pose, camera: Camera) -> bool:
        """Tell if a page's camera has the place and the direction of a scene's camera."""
        return self.stands_at(pose, camera_center(camera.R, camera.T), np.asarray(camera.R))


def fit_canvas(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The smallest (width, height) of an aspect in which an image fits."""
    if width < aspect * height:
        return max(width, round(height * aspect)), height
    return width, max(height, round(width / aspect))


def fit_fov(camera: Camera, aspect: float) -> float:
    """Vertical opening angle, radians, of a window of this aspect that shows all of a camera's image."""
    _, height = fit_canvas(camera.image_width, camera.image_height, aspect)
    return 2 * math.atan(math.tan(vertical_fov(camera) / 2) * height / camera.image_height)


def overview_fov(aspect: float) -> float:
    """Vertical opening angle, radians, of a window of this aspect that shows what `overview` is to show."""
    return 2 * math.atan(math.tan(_OF_ALL / 2) / min(1.0, aspect))
