"""Poses of many cameras as arrays, the point that they look at, and the pose that looks at a point."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from diff_gaussian_rasterization.reference.lens import rays

from gaussian_renderer.camera_paths.keyframes import Keyframe
from scene.cameras import Camera
from scene.readers.start_cloud import nearest_to_axes

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SAME_PLACE = 1e-6  # of the distance from the origin, or of 1: float32 tells no smaller distances apart
WIDEST = 60.0  # degrees; vertical opening of a pinhole view in place of a fisheye's or a panorama's


@dataclass(frozen=True)
class Poses:
    """N poses, float64.

    positions: (N,3) in the frame of training. turns: (N,3,3), from camera axes (x right, y down, z forward) to world
    axes. fov: (N,) vertical opening angles in degrees.
    """

    positions: np.ndarray
    turns: np.ndarray
    fov: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows: np.ndarray) -> "Poses":
        return Poses(self.positions[rows], self.turns[rows], self.fov[rows])

    @property
    def forward(self) -> np.ndarray:
        """The optical axes (N,3), of length 1."""
        return self.turns[:, :, 2]

    @property
    def up(self) -> np.ndarray:
        """The mean of the cameras' up directions (3,), not normalised."""
        return -self.turns[:, :, 1].mean(axis=0)

    @property
    def spread(self) -> float:
        """`spread_of` the cameras."""
        return spread_of(self.positions)

    @property
    def quaternions(self) -> np.ndarray:
        """The turns as unit quaternions (N,4) wxyz."""
        return _make_rotations(self.turns).as_quat(scalar_first=True)


def _make_rotations(turns: np.ndarray) -> "Rotation":
    from scipy.spatial.transform import Rotation  # takes a while to import

    return Rotation.from_matrix(turns)


def spread_of(positions: np.ndarray) -> float:
    """Mean distance of positions (N,3) from their middle, 0 where they are all in one place."""
    spread = np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean()
    return float(spread) if spread > SAME_PLACE * max(1.0, float(np.abs(positions).max())) else 0.0


def poses_of(cameras: Sequence[Camera]) -> Poses:
    """The poses of views, by their matrices."""
    views = _matrices(cameras)
    turns = _make_rotations(views[:, :3, :3].transpose(0, 2, 1)).as_matrix()
    return Poses(_positions(views), turns, np.degrees([vertical_fov(camera) for camera in cameras]))


def positions_of(cameras: Sequence[Camera]) -> np.ndarray:
    """The positions (N,3) float64 of views, without SciPy, which takes a while to import."""
    return _positions(_matrices(cameras))


def _matrices(cameras: Sequence[Camera]) -> np.ndarray:
    return np.stack([camera.world_view_transform.detach().cpu().double().numpy().T for camera in cameras])


def _positions(views: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(views[:, :3, :3], views[:, :3, 3:])[..., 0]


def vertical_fov(camera: Camera) -> float:
    """Vertical opening angle, radians, of a pinhole view that stands for a camera; at most WIDEST for a wide lens."""
    lens = getattr(camera, "lens", None)
    wide = lens is not None and lens.chart != "perspective"
    return min(float(camera.FoVy), np.radians(WIDEST)) if wide else float(camera.FoVy)


def ray_through(camera: Camera, x: float, y: float) -> np.ndarray:
    """The direction (3,) in the world of a pixel of a camera's photo, counted from the left and the top of the file.

    The length is arbitrary, and 0 where the lens shows nothing.
    """
    size = np.array([camera.image_width, camera.image_height])
    share = np.array([x, y]) / getattr(camera, "photo_size", size)
    if lens := getattr(camera, "lens", None):
        alone = lens._replace(center=tuple((lens.center - share * size + 0.5).tolist()))  # in an image of one pixel
        return poses_of([camera]).turns[0] @ rays(alone, 1, 1)[0, 0].numpy()
    full = camera.full_proj_transform.double().cpu().numpy()[:3]
    ray = np.cross(*(full[:, :2] - full[:, 3:] * (2 * share - 1)).T)
    return ray * np.sign(ray @ full[:, 3])


def unit(vector: np.ndarray) -> np.ndarray:
    """Scale a vector (3,) to length 1."""
    return vector / np.linalg.norm(vector)


def look_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The turn (3,3), from camera to world axes, of a camera that looks along `forward`, its head towards `up`.

    The two directions (3,) may have any length; they must not be parallel.
    """
    z = unit(forward)
    x = unit(np.cross(-up, z))
    return np.column_stack([x, np.cross(z, x), z])


def keyframe(seconds: float, position: np.ndarray, turn: np.ndarray, fov: float) -> Keyframe:
    """Make a Keyframe of a pose with a turn (3,3)."""
    wxyz = _make_rotations(turn).as_quat(scalar_first=True)
    return Keyframe(seconds, tuple(position.tolist()), tuple(wxyz.tolist()), float(fov))


def focus_point(poses: Poses) -> np.ndarray | None:
    """The point (3,) nearest to all optical axes, None if these are parallel or most cameras look away from it."""
    found = nearest_to_axes(poses.positions, poses.forward)
    return found[0] if found else None
