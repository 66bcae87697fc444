"""Views without a photo: from any pose, and between neighbouring cameras, where a visitor may stand."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from scene.cameras import ZFAR, ZNEAR, Camera, MiniCam
from utils.graphics_utils import camera_center, focal2fov, projection, world_to_camera

NEAREST = 3  # neighbours of each camera; in a sequence and in a ring its two sides are among them
FRACTIONS = (0.2, 0.4, 0.6, 0.8)  # of the way from a camera to its neighbour
WIDER = 1.5  # size of a view between, in sizes of its cameras: a visitor may look elsewhere than they did


def free_view(
    width: int, height: int, fov_y: float, position: Sequence[float], wxyz: Sequence[float], device: torch.device | str
) -> MiniCam:
    """Make a view with square pixels.

    fov_y: vertical opening angle, radians.
    position: the camera's centre in the world.
    wxyz: unit quaternion that turns camera axes (x right, y down, z forward) into world axes.
    """
    fov_x = 2 * math.atan(math.tan(fov_y / 2) * width / height)
    project = projection(ZNEAR, ZFAR, fov_x, fov_y)
    return _make_view(
        width, height, fov_y, fov_x, rotation_matrix(wxyz), np.asarray(position, np.float64), project, device
    )


def _make_view(
    width: int,
    height: int,
    fov_y: float,
    fov_x: float,
    turn: np.ndarray,
    center: np.ndarray,
    project: torch.Tensor,
    device: torch.device | str,
) -> MiniCam:
    """Make a view. turn: rotation from camera to world axes. project: the projection matrix."""
    view = torch.from_numpy(world_to_camera(turn, -turn.T @ center))
    matrices = [m.T.to(device, torch.float32).contiguous() for m in (view, project @ view)]
    return MiniCam(width, height, fov_y, fov_x, ZNEAR, ZFAR, *matrices)


def rotation_matrix(wxyz: Sequence[float]) -> np.ndarray:
    """The rotation (3,3) float64 of a unit quaternion."""
    w, x, y, z = map(float, wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def neighbours(cameras: Sequence[Camera], nearest: int = NEAREST) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of cameras to walk between, by their index; ascending.

    A pair's distance is the distance of the centres plus the angle between the orientations, each divided by its median
    over all pairs. Each camera is paired with its `nearest` ones; the minimum spanning tree is added, so that groups of
    cameras far from each other are joined, too. Memory: some 50 bytes for each two cameras.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree  # SciPy takes a while to import

    count = len(cameras)
    if count < 2:
        return []
    distances = _measure_distances(cameras)
    tree = minimum_spanning_tree(1 + distances)  # a weight of 0 would be no edge
    pairs = {(min(i, j), max(i, j)) for i, j in np.argwhere(tree.toarray()).tolist()}
    np.fill_diagonal(distances, np.inf)
    for i, order in enumerate(np.argsort(distances, axis=1, kind="stable")[:, : min(nearest, count - 1)].tolist()):
        pairs |= {(min(i, j), max(i, j)) for j in order}
    return sorted(pairs)


def _measure_distances(cameras: Sequence[Camera]) -> np.ndarray:
    """(N, N) distances of `neighbours`."""
    centers = np.array([camera_center(camera.R, camera.T) for camera in cameras])
    turns = np.array([camera.R for camera in cameras]).reshape(-1, 9)
    far = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    turned = np.arccos(np.clip((turns @ turns.T - 1) / 2, -1, 1))  # the trace of Ra^T Rb is 1 + 2 cos(angle)
    total = np.zeros_like(far)
    above = np.triu_indices(len(cameras), 1)
    for part in (far, turned):
        if (unit := np.median(part[above])) > 0:
            total += part / unit
    return total


def views_between(first: Camera, second: Camera) -> list[MiniCam]:
    """Make a view at each of FRACTIONS of the way between two cameras, WIDER than they are.

    Positions, focal lengths and principal points are interpolated linearly, orientations along the shortest rotation
    (slerp). Where the sizes differ, the larger width and height count.
    """
    from scipy.spatial.transform import Rotation, Slerp

    turns = Slerp([0, 1], Rotation.from_matrix([first.R, second.R]))(FRACTIONS).as_matrix()
    return [_interpolate_view(first, second, *place) for place in zip(FRACTIONS, turns, strict=True)]


def _interpolate_view(first: Camera, second: Camera, fraction: float, turn: np.ndarray) -> MiniCam:
    """Interpolate the view between two cameras, from the first (fraction 0) to the second (1), a little wider than
    both. turn: rotation (3, 3) from the view's axes to the world's."""

    def mixed(one: float, other: float) -> float:
        return (1 - fraction) * one + fraction * other

    center = mixed(*(camera_center(camera.R, camera.T) for camera in (first, second)))
    width = math.ceil(WIDER * max(first.image_width, second.image_width))
    height = math.ceil(WIDER * max(first.image_height, second.image_height))
    fovx, fovy = focal2fov(mixed(first.fx, second.fx), width), focal2fov(mixed(first.fy, second.fy), height)
    # Offsets of the principal point from the image's centre stay what they are in pixels.
    shift_x = mixed(first.cx - first.image_width / 2, second.cx - second.image_width / 2)
    shift_y = mixed(first.cy - first.image_height / 2, second.cy - second.image_height / 2)
    project = projection(ZNEAR, ZFAR, fovx, fovy, 2 * shift_x / width, 2 * shift_y / height)
    return _make_view(width, height, fovy, fovx, turn, center, project, first.device)
