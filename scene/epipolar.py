"""Epipolar geometry of many pairs of photos at once, by unit rays of their matches, for lenses of any kind.

Arrays of pairs are (P, N, ...): N is the most matches of a pair, and `used` (P, N) is 1 for those of a pair, else 0.
"""

import numpy as np


def epipolar_angles(shift: np.ndarray, one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signed angles (...), radians, by which unit rays (..., 3) in one frame miss each other, and their slopes.

    Sampson's first-order distance (Hartley and Zisserman, eq. 11.9), with derivatives on the unit sphere instead of the
    image plane, so that it holds for fisheyes and panoramas, too. The slope divides the algebraic error.

    shift (..., 3): unit vector from the second camera to the first.
    """
    s, a, b = (np.moveaxis(vectors, -1, 0) for vectors in (shift, one, other))
    missed = (
        b[0] * (s[1] * a[2] - s[2] * a[1]) + b[1] * (s[2] * a[0] - s[0] * a[2]) + b[2] * (s[0] * a[1] - s[1] * a[0])
    )
    square = 2 - _dot(shift, one) ** 2 - _dot(shift, other) ** 2 - 2 * missed**2  # of |shift x one|, |shift x other|
    slope = np.sqrt(np.maximum(square, 1e-24))
    return missed / slope, slope


def is_ahead(shift: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Tell which rays meet before both cameras; all as in `epipolar_angles`.

    The points where two rays are closest lie at distances with the signs of (other x shift) (one x other) and
    (one x shift) (one x other).
    """
    between, first, second = _dot(one, other), _dot(shift, one), _dot(shift, other)
    return (between * second > first) & (second > between * first)


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", one, other)


def turn(rotation: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Turn the rays (P, N, 3) of each pair by its rotation (P, 3, 3)."""
    return rays @ rotation.swapaxes(1, 2)


def matrix_angles(matrix: np.ndarray, one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what `epipolar_angles` does for matrices (P, 3, 3) that need not be essential."""
    across, back = turn(matrix, one), other @ matrix
    missed = (other * across).sum(-1)
    square = (across**2).sum(-1) + (back**2).sum(-1) - missed**2 - (back * one).sum(-1) ** 2
    slope = np.sqrt(np.maximum(square, 1e-24))
    return missed / slope, slope


def fit_matrices(one: np.ndarray, other: np.ndarray, used: np.ndarray, rounds: int) -> np.ndarray:
    """Fit a matrix (P, 3, 3) to the rays (P, N, 3) of each pair: the eight-point algorithm, robust by reweighting.

    The matrix need not be essential: so a wrong lens shows, and a plane, which several matrices fit, does no harm.
    """
    spread = [_whiten(rays, used) for rays in (one, other)]
    first, second = turn(spread[0], one), turn(spread[1], other)
    rows = (second[..., :, None] * first[..., None, :]).reshape(*one.shape[:2], 9)
    weight, matrix = used, np.zeros((len(one), 3, 3))
    for _ in range(rounds):
        least = np.linalg.eigh(rows.swapaxes(1, 2) @ (rows * weight[..., None]))[1][..., 0]
        matrix = spread[1].swapaxes(1, 2) @ least.reshape(-1, 3, 3) @ spread[0]
        error, slope = matrix_angles(matrix, one, other)
        usual = np.maximum(1.5 * medians(np.abs(error), used), 1e-12)[:, None]
        weight = used / ((1 + (error / usual) ** 2) * np.maximum(slope**2, 1e-18))
    return matrix


def medians(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the median (P,) of the values (P, N) of each pair that are used, one at least."""
    ordered, count = np.sort(np.where(used > 0, values, np.inf), axis=1), used.sum(1).astype(int)
    row = np.arange(len(values))
    return (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2


def _whiten(rays: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the change of axes (P, 3, 3) that spreads the rays of a pair over all directions.

    Else the equations of a narrow view are nearly singular.
    """
    moments = rays.swapaxes(1, 2) @ (rays * used[..., None]) / np.maximum(used.sum(1), 1)[:, None, None]
    return np.linalg.inv(np.linalg.cholesky(moments + 1e-12 * np.eye(3)))
