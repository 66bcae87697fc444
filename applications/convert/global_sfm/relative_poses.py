"""Relative poses of many pairs of photos at once, from matches whose outliers a geometric check has mostly removed.

An essential matrix by the eight-point algorithm, robust by reweighting, gives a rotation and a direction (Hartley and
Zisserman, 9.6). Gauss-Newton steps then reduce Sampson's angles under Cauchy's loss, and their covariance tells how
well the rotation is known: a pair without parallax, or of a plane, has a wide one.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from groundwork.host.machine import threads
from scene.epipolar import epipolar_angles, fit_matrices, is_ahead, medians, turn

SAMPLED = 100  # matches of a pair that are asked
_AT_ONCE = 250  # pairs of a thread, so that memory is bounded
_FITS, _STEPS = 4, 5
_LEAST = 1e-5  # radians: no match is more exact


class RelativePoses(NamedTuple):
    """Poses of pairs.

    rotations (P, 3, 3): from the first camera's frame to the second's.
    directions (P, 3): unit vectors of the translation between them.
    spreads (P,): standard deviations of the rotations, radians.
    ahead (P,): shares of the matches that lie before both cameras.
    """

    rotations: np.ndarray
    directions: np.ndarray
    spreads: np.ndarray
    ahead: np.ndarray


def relative_poses(pair: np.ndarray, one: np.ndarray, other: np.ndarray) -> RelativePoses:
    """Estimate the pose of each pair.

    pair (M,): numbers of the matches' pairs, ascending from 0 without a gap, each eight times or more.
    one, other (M, 3): unit rays of the matches in the cameras' frames of a pair's two photos; zeros do not count.
    """
    counts = np.bincount(pair)
    starts = np.cumsum(counts) - counts
    taken = np.minimum(counts, SAMPLED)
    column = np.arange(SAMPLED)
    # Of each pair the same number of matches, evenly; those beyond its own number have no weight.
    rows = starts[:, None] + np.minimum(column * counts[:, None] // taken[:, None], counts[:, None] - 1)

    def pose_some(start: int) -> tuple[np.ndarray, ...]:
        some = rows[start : start + _AT_ONCE]
        used = (column < taken[start : start + _AT_ONCE, None]) & one[some].any(-1) & other[some].any(-1)
        used[:, 0] |= ~used.any(1)  # a pair without rays is as good as one with a single match
        return _pose_pairs(one[some], other[some], used.astype(float))

    none = RelativePoses(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    with ThreadPoolExecutor(threads()) as pool:
        parts = [none, *pool.map(pose_some, range(0, len(counts), _AT_ONCE))]
    return RelativePoses(*map(np.concatenate, zip(*parts, strict=True)))


def cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of the cross product by vectors (..., 3) from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)


def rotate_by(vectors: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) by vectors (..., 3), axis times angle (Rodrigues)."""
    angle = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-12)[..., None, None]
    matrix = cross_matrix(vectors)
    return np.eye(3) + np.sin(angle) / angle * matrix + (1 - np.cos(angle)) / angle**2 * (matrix @ matrix)


def _pose_pairs(one: np.ndarray, other: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, ...]:
    rotation, direction = _choose_pose(fit_matrices(one, other, used, _FITS), one, other, used)
    damping = np.full(len(one), 1e-3)
    error, slope = epipolar_angles(direction[:, None], turn(rotation, one), other)
    width = _error_widths(error, used)
    for _ in range(_STEPS):
        weight = used / (1 + (error / width) ** 2)
        normal, right, sides = _normal_equations(rotation, direction, one, other, weight, error, slope)
        normal[:, range(5), range(5)] *= 1 + damping[:, None]
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        new = rotate_by(step[:, :3]) @ rotation
        moved = direction + np.einsum("pk,pki->pi", step[:, 3:], sides)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        now, steep = epipolar_angles(moved[:, None], turn(new, one), other)
        better = _cauchy_loss(now, width, used) < _cauchy_loss(error, width, used)
        for old, changed in ((rotation, new), (direction, moved), (error, now), (slope, steep)):
            old[better] = changed[better]
        damping = np.where(better, damping / 5, damping * 10)
        width = _error_widths(error, used)
    weight = used / (1 + (error / width) ** 2)
    normal, _, _ = _normal_equations(rotation, direction, one, other, weight, error, slope)
    variance = np.trace(np.linalg.inv(normal)[:, :3, :3], axis1=1, axis2=2)
    spread = np.sqrt(variance) * width[:, 0] * 0.74  # Gaussian: 1.48 medians, of which width has two
    return rotation, direction, spread, _share_ahead(direction, turn(rotation, one), other, used)


def _choose_pose(
    matrix: np.ndarray, one: np.ndarray, other: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Choose of the four poses of an essential matrix the one with most matches before both cameras."""
    left, _, right = np.linalg.svd(matrix)
    left, right = (part * np.sign(np.linalg.det(part))[:, None, None] for part in (left, right))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turns = left @ quarter @ right, left @ quarter.T @ right
    poses = [(rotation, sign * left[:, :, 2]) for rotation in turns for sign in (1, -1)]
    ahead = [_share_ahead(direction, turn(rotation, one), other, used) for rotation, direction in poses]
    best = np.stack(ahead).argmax(0)
    rotation, direction = (np.stack(parts)[best, np.arange(len(best))] for parts in zip(*poses, strict=True))
    return rotation, direction


def _share_ahead(direction: np.ndarray, one: np.ndarray, other: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return for each pair the share of matches (P, N, 3) that meet before both cameras; used (P, N): weights."""
    return (is_ahead(direction[:, None], one, other) & (used > 0)).sum(1) / np.maximum(used.sum(1), 1)


def _error_widths(error: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return twice the median (P, 1) of the absolute errors (P, N) that count."""
    return np.maximum(2 * medians(np.abs(error), used), _LEAST)[:, None]


def _cauchy_loss(error: np.ndarray, width: np.ndarray, used: np.ndarray) -> np.ndarray:
    return (used * np.log1p((error / width) ** 2)).sum(1)


def _normal_equations(
    rotation: np.ndarray,
    direction: np.ndarray,
    one: np.ndarray,
    other: np.ndarray,
    weight: np.ndarray,
    error: np.ndarray,
    slope: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normal matrices (P, 5, 5) and right sides (P, 5) of a step, and the two sides (P, 2, 3) of the direction.

    A step turns the rotation by three angles in the second camera's frame, and moves the direction along its sides.
    """
    least = np.eye(3)[np.abs(direction).argmin(1)]
    side = np.cross(direction, least)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    sides = np.stack([side, np.cross(direction, side)], 1)
    turned = turn(rotation, one)
    by_turn = np.cross(turned, np.cross(other, direction[:, None]))
    by_move = np.cross(turned, other) @ sides.swapaxes(1, 2)
    slopes = np.concatenate([by_turn, by_move], -1) / slope[..., None]
    weighted = slopes * weight[..., None]
    normal = slopes.swapaxes(1, 2) @ weighted + 1e-9 * np.eye(5)
    return normal, -(weighted * error[..., None]).sum(1), sides
