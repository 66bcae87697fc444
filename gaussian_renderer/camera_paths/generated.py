"""Paths made from the training cameras: through the cameras, around their focus, and a spiral in front of it."""

import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from gaussian_renderer.camera_paths.keyframes import Keyframe, TimedPath
from gaussian_renderer.camera_paths.poses import Poses, focus_point, keyframe, look_along, unit
from utils.system_utils import UserError

SECONDS = 10.0  # of a path for which no other time is asked
KEYS_A_SECOND = 3  # cameras that `interpolate` passes at most: a path through every hand-held photo would shake
MOST = 1000  # cameras that are looked at: the distances of all pairs take 8 MB
_PASSES = 50
_SEGMENT_SAMPLES = 32  # of each segment, to measure its length
_STEP = 1e-9  # of the whole way: poses closer than this are one
_LARGEST_GAP = math.radians(120)  # between cameras around the focus: over it, no image shows what is seen from there
_LEAST_SWAY = math.radians(10)
_TILT = 0.8  # cosine of the angle between the cameras' plane and their up, from which the plane is believed
_OVERHEAD = 0.1  # sine of the angle between line of sight and up, below which the image would spin
_ONE_WAY = 0.7  # length of the mean optical axis, from which cameras face one way
_SAMPLES = 720


class Interpolated:
    """A camera that passes through the training cameras, at constant speed.

    Positions, quaternions and opening angles are one centripetal Catmull-Rom spline (Barry and Goldman, SIGGRAPH 1988;
    its knots by Yuksel, Schaefer and Keyser, CAD 2011: no cusps, no loops). Quaternions are normalised afterwards, and
    each has the sign that is nearer to the one before it, so turns take the short way. Position and orientation have
    continuous first derivatives. Opening angles stay between the smallest and the largest of the cameras.
    """

    closed = False

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        """Order the poses (N) along a way and fit a smooth curve to it, passed at a constant speed in `seconds`.

        UserError for fewer than two different poses.
        """
        self.seconds = seconds
        ordered = poses[visiting_order(poses)]
        self.keys = keys = without_repeats(ordered[spread_along(ordered, max(2, round(KEYS_A_SECOND * seconds)))])
        if len(keys) < 2:
            raise UserError(
                "--path interpolate needs two training cameras with different poses, and the scene has "
                "one; write keyframes into a file and pass that as --path"
            )
        rows = np.column_stack([keys.positions, _align_signs(keys.quaternions), keys.fov])
        self._radius = turning_radius(keys)
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(self._measure_steps(rows)))])
        # Tangents of the parabola through a row and its neighbours; at the ends, of the line.
        self._curve = CubicHermiteSpline(knots, rows, np.gradient(rows, knots, axis=0))
        samples = np.unique(np.linspace(knots[:-1], knots[1:], _SEGMENT_SAMPLES + 1))
        way = np.concatenate([[0.0], np.cumsum(self._measure_steps(self._evaluate_rows(samples)))])
        grows = np.concatenate([[True], np.diff(way) > _STEP * way[-1]])
        # Monotone and smooth, so that speed is constant and does not jump at the samples.
        self._knot_at = PchipInterpolator(way[grows] / way[grows][-1], samples[grows])

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        row = self._evaluate_rows(self._knot_at(np.array([seconds / self.seconds])))[0].tolist()
        return Keyframe(seconds, tuple(row[:3]), tuple(row[3:7]), row[7])

    def _evaluate_rows(self, knots: np.ndarray) -> np.ndarray:
        rows = self._curve(knots)
        rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
        rows[:, 7] = rows[:, 7].clip(self.keys.fov.min(), self.keys.fov.max())
        return rows

    def _measure_steps(self, rows: np.ndarray) -> np.ndarray:
        """`distances` of neighbours, by chords: arccos has no digits left for small turns."""
        change = np.diff(rows, axis=0)
        half = np.linalg.norm(change[:, 3:7], axis=1) / 2
        return np.linalg.norm(change[:, :3], axis=1) + self._radius * 4 * np.arcsin(np.minimum(half, 1.0))


class Ellipse:
    """A closed path around the point nearest to all optical axes, looking at it (after Barron et al., Mip-NeRF 360).

    The path lies in the plane of the cameras (principal components), at their mean height over it; up is their mean up.
    If that plane is not level, as of cameras on a wall or on a line, a level one takes its place. 90 % of the cameras
    are within the half axes. Speed is constant. If cameras leave a gap of over 120 degrees, the path sways to and fro
    on the arc that they cover, at their median distance.
    """

    closed = True

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        """Fit the ellipse around the point that the cameras of `poses` look at. UserError where they look at none."""
        self.seconds = seconds
        _refuse_one_place(poses, "ellipse")
        focus = focus_point(poses)
        if focus is None:
            raise UserError(
                "--path ellipse needs training cameras that look at one point, and these look past each other or "
                "outwards; take --path interpolate, or spiral if they face one way"
            )
        self.focus, self._fov = focus, float(np.median(poses.fov))
        normal = plane_normal(poses)
        self.up = normal if np.linalg.norm(poses.up) < _OVERHEAD else unit(poses.up)
        self._offset = ring(poses, focus, normal)
        sights = [unit(self._offset(share)) for share in np.linspace(0, 1, 90)]
        if min(np.linalg.norm(np.cross(sight, self.up)) for sight in sights) < _OVERHEAD:
            self._offset = ring(poses, focus, self.up)

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        offset = self._offset(seconds / self.seconds)
        return keyframe(seconds, self.focus + offset, look_along(-offset, self.up), self._fov)


class Spiral:
    """A closed path of two turns about the mean camera, for cameras that face one way (after Mildenhall et al., LLFF).

    90 % of the cameras are within its radii, to the sides, up and along the axis. The path looks at the point nearest
    to the optical axes, moved onto the mean axis, or straight ahead if the axes are parallel.
    """

    closed = True

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        """Fit the spiral to `poses` that face one way. UserError for poses that do not."""
        self.seconds = seconds
        _refuse_one_place(poses, "spiral")
        mean = poses.forward.mean(axis=0)
        if np.linalg.norm(mean) < _ONE_WAY or np.linalg.norm(np.cross(poses.up, unit(mean))) < _OVERHEAD:
            raise UserError(
                "--path spiral needs training cameras that face one way, and these face many; take --path ellipse or "
                "interpolate"
            )
        self._up, self._fov = unit(poses.up), float(np.median(poses.fov))
        self.middle, self._frame = poses.positions.mean(axis=0), look_along(mean, self._up)
        self.radii = np.percentile(np.abs((poses.positions - self.middle) @ self._frame), 90, axis=0)
        focus = focus_point(poses)
        depth = 0.0 if focus is None else float((focus - self.middle) @ self._frame[:, 2])
        self.target = self.middle + depth * self._frame[:, 2] if depth > 2 * self.radii[2] else None

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        angle = 4 * math.pi * seconds / self.seconds
        share = np.array([math.cos(angle), -math.sin(angle), -math.sin(angle / 2)])
        position = self.middle + self._frame @ (share * self.radii)
        turn = self._frame if self.target is None else look_along(self.target - position, self._up)
        return keyframe(seconds, position, turn, self._fov)


GENERATED: dict[str, Callable[[Poses, float], TimedPath]] = {
    "interpolate": Interpolated,
    "ellipse": Ellipse,
    "spiral": Spiral,
}


def turning_radius(poses: Poses) -> float:
    """The length that stands for a turn of one radian in `distances`: the cameras' mean distance from their middle.

    1 if all cameras are in one place.
    """
    return poses.spread or 1.0


def visiting_order(poses: Poses) -> np.ndarray:
    """Indices of the poses in the order of a path.

    The given order is kept, unless a tour is less than half as long: the nearest camera next, beginning at the first,
    then improved by 2-opt (Croes 1958). So a filmed walk keeps its order, and unordered photos get a short path. Of
    more than MOST poses, MOST are taken, evenly.
    """
    kept = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST)).round().astype(int))
    table = distances(poses[kept])
    given = np.arange(len(kept))
    tour = _improve_order(_order_by_nearest(table), table)
    return kept[tour if _sum_lengths(tour, table) < _sum_lengths(given, table) / 2 else given]


def spread_along(poses: Poses, count: int) -> np.ndarray:
    """Indices of at most `count` poses, spread evenly along the path through all of them, with both ends."""
    if len(poses) <= count:
        return np.arange(len(poses))
    way = np.concatenate([[0.0], np.cumsum(np.diagonal(distances(poses), 1))])
    shares = np.linspace(0, way[-1], count)
    right = np.searchsorted(way, shares).clip(1, len(way) - 1)
    return np.unique(np.where(shares - way[right - 1] < way[right] - shares, right - 1, right))


def distances(poses: Poses) -> np.ndarray:
    """Distances between poses (N,N), in world units: distance moved plus `turning_radius` x radians turned."""
    radius, quaternions = turning_radius(poses), poses.quaternions
    moved = np.stack([np.linalg.norm(poses.positions - position, axis=1) for position in poses.positions])
    return moved + radius * 2 * np.arccos(np.minimum(np.abs(quaternions @ quaternions.T), 1.0))


def _sum_lengths(order: np.ndarray, table: np.ndarray) -> float:
    return float(table[order[:-1], order[1:]].sum())


def _order_by_nearest(table: np.ndarray) -> np.ndarray:
    """Order rows from 0 on, each time to the nearest one left: (N,) int. table: distances (N, N)."""
    order, left = [0], np.ones(len(table), bool)
    left[0] = False
    while left.any():
        order.append(int(np.where(left, table[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _improve_order(order: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Reverse parts of an open tour as long as that shortens the tour (2-opt); the first pose stays first."""
    order = order.copy()
    for _ in range(_PASSES):
        before = _sum_lengths(order, table)
        for start in range(1, len(order) - 1):
            ends = np.arange(start + 1, len(order))
            after = np.append(order[ends[:-1] + 1], -1)  # the last end has no successor
            beyond = np.where(after >= 0, table[order[start], after] - table[order[ends], after], 0.0)
            gain = table[order[start - 1], order[start]] - table[order[start - 1], order[ends]] - beyond
            if gain.max() > 1e-9:
                end = ends[gain.argmax()]
                order[start : end + 1] = order[start : end + 1][::-1]
        if _sum_lengths(order, table) >= before - 1e-9:
            break
    return order


def without_repeats(poses: Poses) -> Poses:
    """Leave out poses that equal the one before, within rounding."""
    radius = turning_radius(poses)
    rows = np.column_stack([poses.positions, _align_signs(poses.quaternions) * radius])
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    return poses[np.concatenate([[True], steps > 1e-5 * radius])]


def _align_signs(quaternions: np.ndarray) -> np.ndarray:
    """Negate a quaternion where that is nearer to the one before."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def plane_normal(poses: Poses) -> np.ndarray:
    """The normal (3,) of the plane of the cameras, upwards; their mean up if the plane is steep or undefined."""
    length = float(np.linalg.norm(poses.up))
    _, sizes, axes = np.linalg.svd(poses.positions - poses.positions.mean(axis=0))
    flat = len(poses) > 2 and sizes[1] > 1e-3 * sizes[0]
    if length < _OVERHEAD:  # heads in all directions
        return axes[2]
    level = float(axes[2] @ poses.up) / length
    return axes[2] * math.copysign(1.0, level) if flat and abs(level) >= _TILT else poses.up / length


def ring(poses: Poses, focus: np.ndarray, normal: np.ndarray) -> Callable[[float], np.ndarray]:
    """The path of `Ellipse` about a normal (3,): maps a share of it, 0 to 1, to the offset (3,) from the focus."""
    offsets = poses.positions - focus
    height = float((offsets @ normal).mean())
    flat = offsets - (offsets @ normal)[:, None] * normal
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0))
    across = axes - np.outer(axes @ normal, normal)  # axes[0], but where the cameras are in one place of the plane
    first = unit(across[np.linalg.norm(across, axis=1).argmax()])
    first *= math.copysign(1.0, first @ flat[0])  # it begins on the side of the first camera
    plane = np.column_stack([first, np.cross(normal, first)])
    places = flat @ plane
    middle, half = covered_arc(np.arctan2(places[:, 1], places[:, 0]))
    if half < math.pi:
        radius = np.full(2, np.median(np.linalg.norm(places, axis=1)))
        return lambda share: _find_point(radius, middle + half * math.sin(2 * math.pi * share), plane) + height * normal
    radius = np.percentile(np.abs(places), 90, axis=0)
    angle_at = _make_even_angles(radius)
    return lambda share: _find_point(radius, float(angle_at(share)), plane) + height * normal


def covered_arc(angles: np.ndarray) -> tuple[float, float]:
    """Middle and half width of the arc that angles cover, in radians: 0 and pi if they leave no large gap."""
    angles = np.sort(angles)
    gaps = np.diff(np.append(angles, angles[0] + 2 * math.pi))
    widest = int(gaps.argmax())
    if gaps[widest] <= _LARGEST_GAP:
        return 0.0, math.pi
    half = (2 * math.pi - gaps[widest]) / 2
    return float(angles[widest] - half), max(float(half), _LEAST_SWAY)


def _find_point(radius: np.ndarray, angle: float, plane: np.ndarray) -> np.ndarray:
    return plane @ (radius * np.array([math.cos(angle), math.sin(angle)]))


def _make_even_angles(radius: np.ndarray) -> PchipInterpolator:
    """Interpolate the angle on an ellipse with half axes (2,) from a share of its length."""
    angles = np.linspace(0, 2 * math.pi, _SAMPLES + 1)
    steps = np.diff(np.column_stack([radius[0] * np.cos(angles), radius[1] * np.sin(angles)]), axis=0)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    return PchipInterpolator(way / way[-1], angles)


def _refuse_one_place(poses: Poses, name: str) -> None:
    """Raise a UserError if all cameras are in one place. name: of the path, for the message."""
    if not poses.spread:
        raise UserError(
            f"--path {name} needs training cameras in at least two places, and all of them are in one; take --path "
            "interpolate, or write keyframes into a file and pass that as --path"
        )
