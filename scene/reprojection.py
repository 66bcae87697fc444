"""Poses from the tracks of structure from motion: reprojection errors of fixed points.

A twist (6,) is a small motion of a camera in its own frame: a rotation vector (radians), then a translation.
"""

import math
from typing import NamedTuple

import numpy as np

from scene.readers.tracks import PhotoPoints

OUTLIER = 1.0  # pixels; larger errors count linearly (Huber 1964)
BOUND = 0.05  # of a correction: rotation in radians, and translation in extents of the scene
_STEPS = 10
_CHANCE = 10.0  # times what noise makes the loss fall on the mean; poses of structure from motion reach 5
_NEAR = 1e-3  # units of depth, or of distance from a fisheye; nearer points do not count
_BEHIND = 3.0  # radians from the axis; beyond, the smallest turn moves a fisheye's points across the image


class PoseLoss(NamedTuple):
    """The reprojection error of a photo's K points in a pose, and its derivatives by a twist."""

    loss: float  # sum of the points' Huber losses, pixels squared
    gradient: np.ndarray  # (6,), of the loss by the twist
    slope: np.ndarray  # (2, 6, K), of the points' pixels by the twist; 0 for points that do not count
    weight: np.ndarray  # (K,), 1, less for outliers: Huber's weights of least squares
    size: np.ndarray  # (K,), errors, pixels

    @property
    def curvature(self) -> np.ndarray:
        """The Gauss-Newton matrix (6, 6)."""
        return 2 * np.einsum("cjk,clk,k->jl", self.slope, self.slope, self.weight)


def moved_pose(pose: np.ndarray, twist: np.ndarray, unit: float) -> np.ndarray:
    """Move a pose by a twist, and return the new pose (4, 4).

    pose: world-to-camera matrix (4, 4).
    twist: (6,), a rotation vector (radians) and a translation (units), in the camera's frame.
    unit: length of a unit of the translation, in world units.

    By the closed form of `motion` (scene/poses.py) in Murray, Li and Sastry 1994, eq. 2.14 and 2.36, in Python's
    numbers: a call for each step of a training must be quick.
    """
    a, b, c, *shift = np.asarray(twist).tolist()
    angle = math.sqrt(a * a + b * b + c * c)
    near = angle < 1e-3  # terms of the fourth order and above do not count
    first = 1 - angle**2 / 6 if near else math.sin(angle) / angle
    second = 0.5 - angle**2 / 24 if near else 2 * (math.sin(angle / 2) / angle) ** 2
    third = 1 / 6 - angle**2 / 120 if near else (1 - first) / angle**2

    def bent(x: float, y: float, z: float, one: float, two: float) -> tuple[float, float, float]:
        """The vector v + one w x v + two w x (w x v), w the rotation."""
        u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
        return (
            x + one * u + two * (b * w - c * v),
            y + one * v + two * (c * u - a * w),
            z + one * w + two * (a * v - b * u),
        )

    columns = [bent(*column, first, second) for column in pose[:3].T.tolist()]
    moved = bent(*(unit * value for value in shift), second, third)
    found = np.array([(*column, 0.0) for column in columns]).T
    found[:3, 3] += moved
    found[3, 3] = 1.0
    return found


def twist_gradient(pose: np.ndarray, gradient: np.ndarray, unit: float) -> np.ndarray:
    """Turn the gradient of a loss by a camera's numbers into the gradient (6,) by `moved_pose`'s twist at 0.

    Returns the derivatives by the twist's rotation (3, per radian), then by its translation (3, per unit). By the chain
    rule: a twist (w, v) changes a column c of the rotation by w x c, the translation t by w x t + v, and the centre by
    -rotation^T v.

    pose: world-to-camera matrix (4, 4) of the camera.
    gradient: of the loss by the camera's numbers, in the order of diff_gaussian_rasterization/camera.py. The first 15
        are read: the rotation of `pose` row by row (9), its translation (3), and the camera's centre in the world (3).
    unit: length of a unit of the twist's translation, in world units.
    """
    columns, given = pose[:3].T.tolist(), gradient[:15].tolist()
    turn, center = [0.0, 0.0, 0.0], given[12:]
    for (x, y, z), (u, v, w) in zip(columns, (given[0:9:3], given[1:9:3], given[2:9:3], given[9:12]), strict=True):
        turn[0] += y * w - z * v
        turn[1] += z * u - x * w
        turn[2] += x * v - y * u
    move = [
        unit * (of_shift - sum(column[row] * value for column, value in zip(columns, center, strict=False)))
        for row, of_shift in enumerate(given[9:12])
    ]
    return np.array(turn + move)


def pose_loss(pose: np.ndarray, photo: PhotoPoints, focal: float, unit: float) -> PoseLoss:
    """Compute the reprojection error of a photo's points in a pose, with derivatives by `moved_pose`'s twist at 0.

    pose: world-to-camera matrix (4, 4).
    photo: 3D points, and their rays in the photo.
    focal: focal length, pixels.
    unit: length of the twist's unit of translation, in world units."""
    local = np.einsum("ij,kj->ik", pose[:3, :3], photo.points) + pose[:3, 3:]
    rays, rows, seen = (_project_fisheye if photo.angular else _project_pinhole)(local, unit)
    shown = focal * seen
    error = shown * (rays - photo.rays.T)
    slope, size = shown * rows, np.hypot(*error)
    weight = OUTLIER / np.maximum(size, OUTLIER)
    loss = np.where(size <= OUTLIER, size**2, OUTLIER * (2 * size - OUTLIER)).sum()
    # einsum has one order of sums, whatever the number of threads.
    return PoseLoss(float(loss), 2 * np.einsum("cjk,ck->j", slope, weight * error), slope, weight, size)


def _project_pinhole(local: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points (3, K) of a view's frame to rays of a pinhole, x / z and y / z.

    unit: length of the twist's unit of translation, in world units.

    Returns rays (2, K), their derivatives (2, 6, K) by a twist, and the mask (K,) of points that count.
    """
    x, y, z = local
    inverse = 1 / np.maximum(z, _NEAR * unit)
    u, v, zero, near = x * inverse, y * inverse, np.zeros_like(x), unit * inverse
    # d(u, v) of dp = rotation x p + translation.
    rows = [[-u * v, 1 + u * u, -v, near, zero, -u * near], [-1 - v * v, u * v, u, zero, near, -v * near]]
    return np.stack([u, v]), np.array(rows), z > _NEAR * unit


def _project_fisheye(local: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do as `_project_pinhole` with rays of a fisheye (`PhotoPoints.angular`): angles, up to nearly 180 degrees."""
    x, y, z = local
    aside = np.maximum(np.hypot(x, y), 1e-9 * _NEAR * unit)
    square, angle, zero = aside * aside + z * z, np.arctan2(aside, z), np.zeros_like(x)
    stretch = angle / aside
    more = (z / square - stretch) / (aside * aside)
    mixed = more * x * y
    slopes = np.array(  # (2, 3, K), by the point
        [[stretch + more * x * x, mixed, -x / square], [mixed, stretch + more * y * y, -y / square]]
    )
    moves = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]])  # (3, 3, K): of the point, by turns about the axes
    rows = np.concatenate([np.einsum("cik,ijk->cjk", slopes, moves), unit * slopes], 1)
    return stretch * np.stack([x, y]), rows, (square > (_NEAR * unit) ** 2) & (angle < _BEHIND)


def damped(curvature: np.ndarray) -> np.ndarray:
    """Return a curvature (6, 6) with a little added to its diagonal, so that it has an inverse even without points."""
    return curvature + max(1e-9 * np.trace(curvature), 1e-30) * np.eye(6)


def nearest_pose(pose: np.ndarray, photo: PhotoPoints | None, focal: float, unit: float, bound: float) -> np.ndarray:
    """Find the pose (4, 4) of least reprojection error near a pose, by Gauss-Newton steps.

    The pose stays as it is without points, if noise explains the gain by the F statistic of its six numbers (Seber and
    Lee 2003, section 4.2), or if rotation (radians) or translation (units) exceed `bound`.

    pose: world-to-camera matrix (4, 4).
    photo: 3D points, and their rays in the photo; None: no points.
    focal: focal length, pixels.
    unit: length of a unit of translation, in world units.
    """
    if photo is None:
        return pose
    found = pose
    for _ in range(_STEPS):
        at = pose_loss(found, photo, focal, unit)
        step = -np.linalg.solve(damped(at.curvature), at.gradient)
        found = moved_pose(found, step, unit)
    change = found @ np.linalg.inv(pose)
    turn = np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))
    apart = np.linalg.norm(change[:3, 3]) / unit
    before, after = (pose_loss(place, photo, focal, unit).loss for place in (pose, found))
    better = (before - after) * (2 * len(photo.points) - 6) > _CHANCE * 6 * after
    return found if better and turn <= bound and apart <= bound else pose
