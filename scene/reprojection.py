"""Poses by the tracks of structure from motion: the reprojection error of points that stay where they are."""

from typing import NamedTuple

import numpy as np
import torch

from scene.poses import motion
from scene.readers.tracks import Track

OUTLIER = 1.0  # pixels; larger errors count linearly (Huber 1964)
_STEPS = 10
_NEAR = 1e-3  # of the median depth; nearer points do not count


class Pull(NamedTuple):
    """A sum of Huber losses (pixels squared), its gradient (6,), and its Gauss-Newton matrix (6, 6), by a twist."""

    loss: float
    gradient: np.ndarray
    curvature: np.ndarray


def moved_pose(pose: np.ndarray, twist: np.ndarray, unit: float) -> np.ndarray:
    """A world-to-camera matrix (4, 4) after a twist (6,) in the camera's frame, whose translation counts units."""
    return motion(torch.from_numpy(_in_world(twist, unit))).numpy() @ pose


def _in_world(twist: np.ndarray, unit: float) -> np.ndarray:
    return np.concatenate([twist[:3], unit * twist[3:]])


def pull(pose: np.ndarray, track: Track, focal: float, unit: float) -> Pull:
    """What the reprojection error of a track says of a pose, by `moved_pose`'s twist at 0. focal: pixels."""
    view = np.einsum("ij,kj->ki", pose[:3, :3], track.points) + pose[:3, 3]
    x, y, z = view.T
    shown = z > _NEAR * abs(np.median(z))
    inverse = np.where(shown, 1 / np.where(shown, z, 1), 0)
    u, v, zero = x * inverse, y * inverse, np.zeros_like(x)
    error = focal * (np.stack([u, v], 1) - track.rays) * shown[:, None]
    # d(u, v) of dp = rotation x p + translation.
    rows = [
        [-u * v, 1 + u * u, -v, unit * inverse, zero, -unit * u * inverse],
        [-1 - v * v, u * v, u, zero, unit * inverse, -unit * v * inverse],
    ]
    slope = focal * np.array(rows).transpose(2, 0, 1) * shown[:, None, None]
    size = np.sqrt((error**2).sum(1))
    weight = np.minimum(1, OUTLIER / np.maximum(size, OUTLIER))
    loss = np.where(size <= OUTLIER, size**2, OUTLIER * (2 * size - OUTLIER)).sum()
    # einsum has one order of sums, whatever the number of threads.
    gradient = 2 * np.einsum("kij,ki,k->j", slope, error, weight)
    return Pull(float(loss), gradient, 2 * np.einsum("kij,kil,k->jl", slope, slope, weight))


def nearest_pose(pose: np.ndarray, track: Track | None, focal: float, unit: float, bound: float) -> np.ndarray:
    """The pose of least reprojection error near a pose, which stays as it is without a track.

    bound: of rotation (radians) and translation (units), beyond which it stays, too.
    """
    if track is None:
        return pose
    found = pose
    for _ in range(_STEPS):
        at = pull(found, track, focal, unit)
        step = -np.linalg.solve(at.curvature + 1e-9 * np.trace(at.curvature) * np.eye(6), at.gradient)
        found = moved_pose(found, step, unit)
    change = found @ np.linalg.inv(pose)
    turn = np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))
    apart = np.linalg.norm(change[:3, 3]) / unit
    better = pull(found, track, focal, unit).loss <= pull(pose, track, focal, unit).loss
    return found if better and turn <= bound and apart <= bound else pose
