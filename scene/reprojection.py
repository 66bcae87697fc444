"""Poses by the tracks of structure from motion: the reprojection error of points that stay where they are."""

import math
from typing import NamedTuple

import numpy as np

from scene.readers.tracks import Track

OUTLIER = 1.0  # pixels; larger errors count linearly (Huber 1964)
BOUND = 0.05  # of a correction: rotation in radians, and translation in extents of the scene
_STEPS = 10
_LESS = 0.9  # of the loss: a pose whose loss falls less stays, since structure from motion has found it
_NEAR = 1e-3  # units of depth; nearer points do not count
_EYE = np.eye(3)


class Pull(NamedTuple):
    """A sum of Huber losses (pixels squared), and its gradient (6,) by a twist."""

    loss: float
    gradient: np.ndarray
    slope: np.ndarray  # (2, 6, K): of the points' pixels
    weight: np.ndarray  # (K,)
    size: np.ndarray  # (K,): errors, in pixels

    @property
    def curvature(self) -> np.ndarray:
        """The Gauss-Newton matrix (6, 6)."""
        return 2 * np.einsum("cjk,clk,k->jl", self.slope, self.slope, self.weight)


def moved_pose(pose: np.ndarray, twist: np.ndarray, unit: float) -> np.ndarray:
    """A world-to-camera matrix (4, 4) after a twist (6,) in the camera's frame, whose translation counts units.

    By the closed form of `motion` (scene/poses.py) in Murray, Li and Sastry 1994, eq. 2.14 and 2.36: a call for each
    step of a training must be quick.
    """
    a, b, c = twist[:3].tolist()
    skew = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    square, angle = skew @ skew, math.sqrt(a * a + b * b + c * c)
    near = angle < 1e-3  # terms of the fourth order and above do not count
    first = 1 - angle**2 / 6 if near else math.sin(angle) / angle
    second = 0.5 - angle**2 / 24 if near else 2 * (math.sin(angle / 2) / angle) ** 2
    third = 1 / 6 - angle**2 / 120 if near else (1 - first) / angle**2
    turn, shift = _EYE + first * skew + second * square, _EYE + second * skew + third * square
    found = pose.copy()
    found[:3] = turn @ pose[:3]
    found[:3, 3] += shift @ (unit * twist[3:])
    return found


def twist_gradient(pose: np.ndarray, numbers: np.ndarray, unit: float) -> np.ndarray:
    """The gradient (6,) of a loss by `moved_pose`'s twist at 0, from that by a camera's numbers.

    numbers: in the order of diff_gaussian_rasterization/camera.py, of which rows and translation of the view, and the
    centre count. A twist (w, v) changes a column c of the rotation by w x c, the translation t by w x t + v, and the
    centre by -rotation^T v.
    """
    turn, shift = pose[:3, :3], pose[:3, 3]
    pairs = np.einsum("ij,kj->ik", turn, numbers[:9].reshape(3, 3)) + np.outer(shift, numbers[9:12])
    skew = pairs - pairs.T
    move = numbers[9:12] - np.einsum("ij,j->i", turn, numbers[12:15])
    return np.array([skew[1, 2], skew[2, 0], skew[0, 1], *unit * move])


def pull(pose: np.ndarray, track: Track, focal: float, unit: float) -> Pull:
    """What the reprojection error of a track says of a pose, by `moved_pose`'s twist at 0. focal: pixels."""
    x, y, z = np.einsum("ij,kj->ik", pose[:3, :3], track.points) + pose[:3, 3:]
    shown = focal * (z > _NEAR * unit)
    inverse = 1 / np.maximum(z, _NEAR * unit)
    u, v, zero, near = x * inverse, y * inverse, np.zeros_like(x), unit * inverse
    error = shown * (np.stack([u, v]) - track.rays.T)
    # d(u, v) of dp = rotation x p + translation.
    rows = [[-u * v, 1 + u * u, -v, near, zero, -u * near], [-1 - v * v, u * v, u, zero, near, -v * near]]
    slope, size = shown * np.array(rows), np.hypot(*error)
    weight = OUTLIER / np.maximum(size, OUTLIER)
    loss = np.where(size <= OUTLIER, size**2, OUTLIER * (2 * size - OUTLIER)).sum()
    # einsum has one order of sums, whatever the number of threads.
    return Pull(float(loss), 2 * np.einsum("cjk,ck->j", slope, weight * error), slope, weight, size)


def nearest_pose(pose: np.ndarray, track: Track | None, focal: float, unit: float, bound: float) -> np.ndarray:
    """The pose of least reprojection error near a pose, which stays as it is without a track, or where little is won.

    bound: of rotation (radians) and translation (units), beyond which it stays, too.
    """
    if track is None:
        return pose
    found = pose
    for _ in range(_STEPS):
        at = pull(found, track, focal, unit)
        damping = max(1e-9 * np.trace(at.curvature), 1e-30)  # more than 0 where no point lies before the camera
        step = -np.linalg.solve(at.curvature + damping * np.eye(6), at.gradient)
        found = moved_pose(found, step, unit)
    change = found @ np.linalg.inv(pose)
    turn = np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))
    apart = np.linalg.norm(change[:3, 3]) / unit
    better = pull(found, track, focal, unit).loss < _LESS * pull(pose, track, focal, unit).loss
    return found if better and turn <= bound and apart <= bound else pose
