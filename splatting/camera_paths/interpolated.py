"""A path through the training cameras: their order, and a smooth curve through them at constant speed."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from splatting.camera_paths.keyframes import Keyframe
from splatting.camera_paths.poses import Poses
from utils.system_utils import UserError

SECONDS = 10.0  # of a path for which no other time is asked
KEYS_A_SECOND = 3  # cameras that `interpolate` passes at most: a path through every hand-held photo would shake
MOST = 1000  # cameras that are looked at: the distances of all pairs take 8 MB
_PASSES = 50
_SAMPLES = 32  # of each segment, to measure its length
_STEP = 1e-9  # of the whole way: poses closer than this are one


class Interpolated:
    """A camera that passes through the training cameras, at constant speed.

    Positions, quaternions and opening angles are one centripetal Catmull-Rom spline (Barry and Goldman, SIGGRAPH 1988;
    its knots by Yuksel, Schaefer and Keyser, CAD 2011: no cusps, no loops). Quaternions are normalised afterwards, and
    each has the sign that is nearer to the one before it, so turns take the short way. Position and orientation have
    continuous first derivatives. Opening angles stay between the smallest and the largest of the cameras.
    """

    closed = False

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        self.seconds = seconds
        ordered = poses[visiting_order(poses)]
        self.keys = keys = without_repeats(ordered[spread_along(ordered, max(2, round(KEYS_A_SECOND * seconds)))])
        if len(keys) < 2:
            raise UserError(
                "--path interpolate needs two training cameras with different poses, and the scene has "
                "one; write keyframes into a file and pass that as --path"
            )
        rows = np.column_stack([keys.positions, _same_side(keys.quaternions), keys.fov])
        self._radius = turning_radius(keys)
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(self._steps(rows)))])
        self._curve = CubicHermiteSpline(knots, rows, _tangents(knots, rows))
        samples = np.unique(np.linspace(knots[:-1], knots[1:], _SAMPLES + 1))
        way = np.concatenate([[0.0], np.cumsum(self._steps(self._rows(samples)))])
        grows = np.concatenate([[True], np.diff(way) > _STEP * way[-1]])
        # Monotone and smooth, so that speed is constant and does not jump at the samples.
        self._knot_at = PchipInterpolator(way[grows] / way[grows][-1], samples[grows])

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        row = self._rows(self._knot_at(np.array([seconds / self.seconds])))[0].tolist()
        return Keyframe(seconds, tuple(row[:3]), tuple(row[3:7]), row[7])

    def _rows(self, knots: np.ndarray) -> np.ndarray:
        rows = self._curve(knots)
        rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
        rows[:, 7] = rows[:, 7].clip(self.keys.fov.min(), self.keys.fov.max())
        return rows

    def _steps(self, rows: np.ndarray) -> np.ndarray:
        """`distances` of neighbours, by chords: arccos has no digits left for small turns."""
        change = np.diff(rows, axis=0)
        half = np.linalg.norm(change[:, 3:7], axis=1) / 2
        return np.linalg.norm(change[:, :3], axis=1) + self._radius * 4 * np.arcsin(np.minimum(half, 1.0))


def turning_radius(poses: Poses) -> float:
    """What a turn of one radian counts in `distances`: as much as walking the cameras' mean distance from their middle.

    1 where the cameras are all in one place.
    """
    return poses.spread or 1.0


def visiting_order(poses: Poses) -> np.ndarray:
    """Indices of the poses in the order of a path.

    The order given is kept, unless a tour is less than half as long: the nearest camera next, beginning at the first,
    then improved by 2-opt (Croes 1958). So a walk stays as it was filmed, and photos in no order are not criss-crossed.
    Of more than MOST poses, only MOST are taken, evenly.
    """
    kept = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST)).round().astype(int))
    table = distances(poses[kept])
    given = np.arange(len(kept))
    tour = _improved(_nearest_first(table), table)
    return kept[tour if _length(tour, table) < _length(given, table) / 2 else given]


def spread_along(poses: Poses, count: int) -> np.ndarray:
    """Indices of at most `count` poses, spread evenly along the way through all of them, with both ends."""
    if len(poses) <= count:
        return np.arange(len(poses))
    way = np.concatenate([[0.0], np.cumsum(np.diagonal(distances(poses), 1))])
    shares = np.linspace(0, way[-1], count)
    right = np.searchsorted(way, shares).clip(1, len(way) - 1)
    return np.unique(np.where(shares - way[right - 1] < way[right] - shares, right - 1, right))


def distances(poses: Poses) -> np.ndarray:
    """How far poses are apart (N,N), in world units: distance moved plus `turning_radius` x radians turned."""
    radius, quaternions = turning_radius(poses), poses.quaternions
    moved = np.stack([np.linalg.norm(poses.positions - position, axis=1) for position in poses.positions])
    return moved + radius * 2 * np.arccos(np.minimum(np.abs(quaternions @ quaternions.T), 1.0))


def _length(order: np.ndarray, table: np.ndarray) -> float:
    return float(table[order[:-1], order[1:]].sum())


def _nearest_first(table: np.ndarray) -> np.ndarray:
    order, left = [0], np.ones(len(table), bool)
    left[0] = False
    while left.any():
        order.append(int(np.where(left, table[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _improved(order: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Reverse parts of an open tour as long as that shortens it; its first stays the first."""
    order = order.copy()
    for _ in range(_PASSES):
        before = _length(order, table)
        for start in range(1, len(order) - 1):
            ends = np.arange(start + 1, len(order))
            after = np.append(order[ends[:-1] + 1], -1)  # the last end has no successor
            beyond = np.where(after >= 0, table[order[start], after] - table[order[ends], after], 0.0)
            gain = table[order[start - 1], order[start]] - table[order[start - 1], order[ends]] - beyond
            if gain.max() > 1e-9:
                end = ends[gain.argmax()]
                order[start : end + 1] = order[start : end + 1][::-1]
        if _length(order, table) >= before - 1e-9:
            break
    return order


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
