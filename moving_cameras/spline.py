"""Smooth curves through poses, run through at constant speed."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from moving_cameras.order import turning_radius
from moving_cameras.poses import Poses

_SAMPLES = 32  # of each segment, to measure its length
_STEP = 1e-9  # of the whole way: poses closer than this are one


class PoseSpline:
    """A curve through M poses, each different from the one before it, M at least 2.

    Positions, quaternions and opening angles are one centripetal Catmull-Rom spline (Barry and Goldman, SIGGRAPH 1988;
    its knots by Yuksel, Schaefer and Keyser, CAD 2011: no cusps, no loops). Quaternions are normalised afterwards, and
    each has the sign that is nearer to the one before it, so turns take the short way. Position and orientation have
    continuous first derivatives. Opening angles stay between the smallest and the largest of the poses.
    """

    def __init__(self, poses: Poses) -> None:
        rows = np.column_stack([poses.positions, _same_side(poses.quaternions), poses.fov])
        self._radius = turning_radius(poses)
        self._range = poses.fov.min(), poses.fov.max()
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(self._steps(rows)))])
        self._curve = CubicHermiteSpline(knots, rows, _tangents(knots, rows))
        samples = np.unique(np.linspace(knots[:-1], knots[1:], _SAMPLES + 1))
        way = np.concatenate([[0.0], np.cumsum(self._steps(self._rows(samples)))])
        grows = np.concatenate([[True], np.diff(way) > _STEP * way[-1]])
        # Monotone and smooth, so that speed is constant and does not jump at the samples.
        self._knot_at = PchipInterpolator(way[grows] / way[grows][-1], samples[grows])

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Position (3,), unit quaternion (4,) wxyz and opening angle after a share of the way, 0 to 1."""
        row = self._rows(self._knot_at(np.array([share])))[0]
        return row[:3], row[3:7], float(row[7])

    def _rows(self, knots: np.ndarray) -> np.ndarray:
        rows = self._curve(knots)
        rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
        rows[:, 7] = rows[:, 7].clip(*self._range)
        return rows

    def _steps(self, rows: np.ndarray) -> np.ndarray:
        """`order.distances` of neighbours, by chords: arccos has no digits left for small turns."""
        change = np.diff(rows, axis=0)
        half = np.linalg.norm(change[:, 3:7], axis=1) / 2
        return np.linalg.norm(change[:, :3], axis=1) + self._radius * 4 * np.arcsin(np.minimum(half, 1.0))


def without_repeats(poses: Poses) -> Poses:
    """The poses but for those that equal the one before them, within rounding."""
    radius = turning_radius(poses)
    rows = np.column_stack([poses.positions, _same_side(poses.quaternions) * radius])
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    return poses[np.concatenate([[True], steps > 1e-5 * radius])]


def _same_side(quaternions: np.ndarray) -> np.ndarray:
    """The quaternions, negated where the one before is nearer to that."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _tangents(knots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Derivatives at the knots: those of the parabola through a row and its neighbours; at the ends, of the line."""
    spans = np.diff(knots)[:, None]
    slopes = np.diff(rows, axis=0) / spans
    before, after = spans[:-1], spans[1:]
    inner = (slopes[:-1] * after + slopes[1:] * before) / (before + after)
    return np.concatenate([slopes[:1], inner, slopes[-1:]])
