"""Places of cameras and points from known rotations and tracks, without a start.

Least unsquared deviations (Ozyesil and Singer 2015) between cameras and points: a point is at least one unit before a
camera, and the sum of the distances from the rays is the least. That is convex, and draws the scene together a little.
From there, the sines of the angles between points and rays are made small, under Cauchy's loss. Each step eliminates
the points (Schur complement).
"""

import numpy as np
import scipy.linalg
import scipy.sparse

from applications.convert.global_sfm.tracks import sum_by

_CONVEX, _ANGLES = 12, 30  # steps
_COARSE, _FINE = 0.1, 1e-3  # smallest deviation that is told apart, in the first steps and later
_WIDTH = 0.01  # radians; of the loss
_GAIN = 1e-3  # of the loss in a step, below which it is done


def place(camera: np.ndarray, track: np.ndarray, toward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return places of cameras (C, 3) and points (P, 3), the first camera in the origin.

    camera, track (N,): of each ray, numbers from 0 without a gap. toward (N, 3): unit rays in the world's frame.
    """
    across = np.eye(3) - toward[:, :, None] * toward[:, None, :]
    weight, is_near = np.ones(len(camera)), np.ones(len(camera), bool)
    for number in range(_CONVEX):
        # Where a point is nearer than one unit, it is pulled to that distance; else only towards the ray.
        pull = np.where(is_near[:, None, None], np.eye(3), across) * weight[:, None, None]
        cameras, points = _solve(camera, track, pull, np.where(is_near, weight, 0)[:, None] * toward)
        away = points[track] - cameras[camera]
        along = (away * toward).sum(1)
        is_near = along < 1
        deviation = np.linalg.norm(away - np.maximum(along, 1)[:, None] * toward, axis=1)
        weight = 1 / np.maximum(deviation, _COARSE if number < _CONVEX / 2 else _FINE)
    damping, state = 1e-3, _Angles(camera, track, toward, cameras, points)
    for _ in range(_ANGLES):
        away, distance, along, loss = state.away, state.distance, state.along, state.loss
        weight = state.weight / distance**2
        is_behind = along <= 0  # such points are pulled all the way before the camera
        pull = np.where(is_behind[:, None, None], np.eye(3), across) * weight[:, None, None]
        missed = np.where(is_behind[:, None], away - distance[:, None] * toward, (across @ away[..., None])[..., 0])
        moves = _solve(camera, track, pull, -weight[:, None] * missed, damping)
        moved = cameras + moves[0], points + moves[1]
        new = _Angles(camera, track, toward, *moved)
        if new.loss < loss:
            (cameras, points), state, damping = moved, new, max(damping / 4, 1e-8)
            if loss - new.loss < _GAIN * loss:
                break
        else:
            damping *= 5
    return cameras, points


class _Angles:
    """Angles between rays and points: the loss, and what a step needs of each ray."""

    def __init__(
        self, camera: np.ndarray, track: np.ndarray, toward: np.ndarray, cameras: np.ndarray, points: np.ndarray
    ) -> None:
        self.away = points[track] - cameras[camera]
        self.distance = np.maximum(np.linalg.norm(self.away, axis=1), 1e-12)
        unit = self.away / self.distance[:, None]
        self.along = (unit * toward).sum(1)
        sine = np.linalg.norm(unit - self.along[:, None] * toward, axis=1)
        square = (np.where(self.along <= 0, 2 - sine, sine) / _WIDTH) ** 2
        self.weight, self.loss = 1 / (1 + square), float(np.log1p(square).sum())


def _solve(
    camera: np.ndarray, track: np.ndarray, pull: np.ndarray, right: np.ndarray, damping: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the normal equations of differences of points and cameras; the first camera stays.

    pull (N, 3, 3): matrix of each difference. right (N, 3): its right side for the point, and less it for the camera.
    """
    counts = int(camera.max()) + 1, int(track.max()) + 1
    blocks = []
    for group, count in zip((camera, track), counts, strict=True):
        block = sum_by(group, pull, count)
        size = np.trace(block, axis1=1, axis2=2)[:, None, None] / 3
        blocks.append(block + np.eye(3) * (damping + 1e-9) * np.maximum(size, 1e-12))
    by_camera, by_point = -sum_by(camera, right, counts[0]).ravel(), sum_by(track, right, counts[1])
    inverse = np.linalg.inv(blocks[1])
    mixed = _sparse_blocks(camera, track, -pull, counts)
    reduced = mixed @ _sparse_blocks(np.arange(counts[1]), np.arange(counts[1]), inverse, (counts[1], counts[1]))
    matrix = scipy.linalg.block_diag(*blocks[0]) - (reduced @ mixed.T).toarray()
    matrix[np.diag_indices(len(matrix))] += 1e-10 * np.trace(matrix) / len(matrix)
    cameras = np.zeros(3 * counts[0])
    free = by_camera - reduced @ by_point.ravel()
    cameras[3:] = scipy.linalg.solve(matrix[3:, 3:], free[3:], assume_a="pos", check_finite=False)
    points = (inverse @ (by_point - (mixed.T @ cameras).reshape(-1, 3))[..., None])[..., 0]
    return cameras.reshape(-1, 3), points


def _sparse_blocks(
    rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, counts: tuple[int, int]
) -> scipy.sparse.csr_matrix:
    """Make a sparse matrix of 3x3 blocks (N, 3, 3) at their rows and columns (N,); counts: of blocks each way."""
    inner = np.arange(3)
    row = (3 * rows[:, None, None] + inner[:, None]).repeat(3, 2).ravel()
    column = (3 * columns[:, None, None] + inner).repeat(3, 1).ravel()
    return scipy.sparse.csr_matrix((blocks.ravel(), (row, column)), (3 * counts[0], 3 * counts[1]))
