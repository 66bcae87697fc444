"""The level frame that fits a scene's cameras: by how they are held, and by their places on Earth.

One least-squares fit finds the turn, the scale and the shift into a frame with x east, y down and z north, in metres.
Its evidence, each with the noise that it turns out to have:

- cameras are held level, but for a roll that all have in common (of a mount);
- a gimbal holds all of them at one pitch, which counts if their pitches are equal;
- GPS gives horizontal places and, if they are known, heights. Horizontal places tell the vertical only by what lies out
  of the cameras' plane: a plane that is tilted a little looks the same from above.

So photos straight down are level as soon as they have several headings or GPS. The standard errors say what is known.
"""

from typing import NamedTuple

import numpy as np

GPS_ERROR, HEIGHT_ERROR = 3.0, 5.0  # metres along an axis, of usual GPS
ROLL = 0.05  # radians; a usual one of a camera that is held level
_COMMON = 0.02  # radians; a usual roll that all photos have in common
_HELD_ASIDE = 0.1  # sine; a photo with a larger roll or pitch hardly counts
_STEADIEST = 0.026  # radians; headings that differ by less tell nothing
_STEADY = 0.035  # radians; pitches of a gimbal differ by less, those by hand by more
_WORTH = 1  # photos that the usual noise is worth beside the measured one
_TAIL = 4  # degrees of freedom of Student's t, which noise of GPS has
_WORST = 4  # times the usual noise; more is of places that are wrong
_FAR = 5.0  # standard deviations, from which a place does not fit
_ROUNDS, _PAIRS = 40, 500  # of pairs of photos, where there are many
_APART = 30  # photos, whose rolls are the errors of different moments; of more, the mean is no better
_EQUAL = 10.0  # log likelihood, below which two verticals fit equally well
_UP = 0.15  # mean sine of the pitch from straight down or up, from which photos show which side is up
_UNKNOWN = 1e-6  # weight that keeps what has no evidence, such as a scale without GPS, from being singular
TILT = [0, 2]  # turns about x and z among the unknowns: turn (3), log of scale, shift (3), common roll and pitch


class Cameras(NamedTuple):
    """turns: (N,3,3), camera to world. centers: (N,3). places: (N,3) in the level frame, NaN where unknown."""

    turns: np.ndarray
    centers: np.ndarray
    places: np.ndarray


class Fit(NamedTuple):
    """A centre c lies at scale * rotation @ c + shift in the level frame.

    tilt: standard error of the vertical (radians); by_level: without GPS. size: that of the scale, as a share. fits:
    (N,) bool, whether a photo's GPS does. cost: negative log likelihood.
    """

    rotation: np.ndarray
    scale: float
    shift: np.ndarray
    tilt: float
    by_level: float
    size: float
    fits: np.ndarray
    cost: float


def is_level(found: Fit) -> bool:
    """Tell if the vertical is known: to a degree by two standard errors, or as well as hand-held photos tell it."""
    return found.tilt <= np.radians(0.45) or (np.isfinite(found.tilt) and found.by_level <= np.radians(4))


def fit_level_frame(cameras: Cameras, up: np.ndarray | None = None) -> Fit:
    """The best fit; its `tilt` is infinite where the opposite vertical fits as well.

    up: (3,), a vertical of the world that is measured, and stays.
    """
    if up is not None:
        return _refine_fit(cameras, _find_upright_rotation(up), measured=True)
    normal = np.linalg.svd(cameras.centers - cameras.centers.mean(0))[2][2]
    level = find_level_up(cameras.turns)
    found = sorted(
        (_refine_fit(cameras, _find_upright_rotation(one)) for one in (level, -level, normal, -normal)),
        key=lambda f: f.cost,
    )
    equal = [one for one in found if one.cost < found[0].cost + _EQUAL]
    if all(one.rotation[1] @ found[0].rotation[1] > 0 for one in equal):
        return found[0]
    shown, best = max(((_find_shown_up(cameras, one), one) for one in equal), key=lambda pair: pair[0])
    return best if shown > _UP else best._replace(tilt=np.inf)


def _find_shown_up(cameras: Cameras, found: Fit) -> float:
    return float(np.median(cameras.turns[:, :, 1] @ found.rotation[1]))


def find_level_up(turns: np.ndarray) -> np.ndarray:
    """The direction (3,), of length 1, that is up for most cameras: the one in which their rolls are least.

    turns: (N,3,3), from camera to world axes. A level camera has its x axis at right angles to up. So up is the
    eigenvector of the least eigenvalue of the weighted mean of x x^T. Weights are Cauchy's, 1 / (1 + (roll / ROLL)^2),
    so that photos held aside hardly count. Where cameras face one way, their mean up decides.
    """
    across, ups = turns[:, :, 0], -turns[:, :, 1]
    weights = np.ones(len(turns))
    for _ in range(_ROUNDS // 2):
        mean = weights @ ups
        mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
        matrix = (weights[:, None] * across).T @ across / weights.sum() + 0.01 * (np.eye(3) - np.outer(mean, mean))
        up = np.linalg.eigh(matrix)[1][:, 0]
        up = up if up @ mean >= 0 else -up
        weights = 1 / (1 + (across @ up / ROLL) ** 2)
    return up


def _find_upright_rotation(up: np.ndarray) -> np.ndarray:
    """The least rotation (3,3) that takes a direction to -y."""
    from scipy.spatial.transform import Rotation

    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -float(up[1])
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix()


def _start_fit(cameras: Cameras, rotation: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift of the best similarity of the plan that two photos with GPS determine."""
    here = np.flatnonzero(np.isfinite(cameras.places[:, 0]))
    own, true = (values[here] @ [1, 0, 1j] for values in (cameras.centers @ rotation.T, np.nan_to_num(cameras.places)))
    first, second = np.triu_indices(min(len(here), 32), 1)
    if len(here) > 32:
        first, second = np.random.default_rng(0).integers(len(here), size=(2, _PAIRS))
    known = (np.abs(own[first] - own[second]) > 1e-9 * np.abs(own).max(initial=0)) & (true[first] != true[second])
    if not known.any():
        return rotation, 1.0, np.zeros(3)
    first, second = first[known], second[known]
    factors = (true[second] - true[first]) / (own[second] - own[first])
    shifts = true[first] - factors * own[first]
    away = np.abs(factors[:, None] * own + shifts[:, None] - true) / GPS_ERROR
    best = np.log1p(away**2 / _TAIL).sum(1).argmin()
    factor, shift = factors[best], shifts[best]
    c, s = factor.real / abs(factor), factor.imag / abs(factor)
    heights = (cameras.places - abs(factor) * cameras.centers @ rotation.T)[:, 1]
    down = np.median(heights[np.isfinite(heights)]) if np.isfinite(heights).any() else 0.0
    rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ rotation
    return rotation, abs(factor), np.array([shift.real, down, shift.imag])


class _Rows(NamedTuple):
    """Evidence of one kind. slopes: (K,9) by the unknowns. away: (K,), what remains. weights: (K,), 1 / variance."""

    slopes: np.ndarray
    away: np.ndarray
    weights: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        return (self.slopes * self.weights[:, None]).T @ self.slopes


def _refine_fit(cameras: Cameras, rotation: np.ndarray, measured: bool = False) -> Fit:
    """The fit that Gauss and Newton's method finds from a level frame; `measured`: whose vertical stays."""
    from scipy.spatial.transform import Rotation

    rotation, scale, shift = _start_fit(cameras, rotation)
    common, deviations = np.zeros(2), (GPS_ERROR, HEIGHT_ERROR)
    free = np.full(9, _UNKNOWN)  # weights of the unknowns without evidence
    for _ in range(_ROUNDS):
        level = [] if measured else _make_level_rows(rotation @ cameras.turns, common)
        gps, deviations, away = _make_gps_rows(cameras, rotation, scale, shift, deviations)
        free[7] = 1 / (_COMMON**2 + common[0] ** 2)  # Cauchy's, as a mount may be crooked
        alone = sum((rows.matrix for rows in level), np.diag(free))
        matrix = sum((rows.matrix for rows in gps), alone)
        matrix[TILT, TILT] += 1e8 * measured  # stays
        slope = sum((rows.slopes.T @ (rows.weights * rows.away) for rows in (*level, *gps)), np.zeros(9))
        slope[7] += common[0] * free[7]
        step = -np.linalg.solve(matrix + np.diag([1.0] * 4 + [0.0] * 3 + [1.0] * 2), slope)
        rotation = Rotation.from_rotvec(np.clip(step[:3], -0.3, 0.3)).as_matrix() @ rotation
        scale, shift = float(scale * np.exp(np.clip(step[3], -0.5, 0.5))), shift + step[4:7]
        common = common + step[7:]
        if np.abs(step).max() < 1e-7:
            break
    variances, without_gps = map(np.linalg.inv, (matrix, alone))
    tilt, by_level = (float(np.sqrt(one[TILT, TILT].sum())) for one in (variances, without_gps))
    cost = (_TAIL + 2) / 2 * np.log1p(_measure_distances(away, GPS_ERROR, HEIGHT_ERROR) / _TAIL)
    cost = float(np.nansum(cost) + sum(np.log1p((rows.away / ROLL) ** 2).sum() for rows in level[:1]))
    fits = _measure_distances(away, *deviations) < _FAR**2  # NaN is not
    return Fit(rotation, scale, shift, tilt, by_level, float(np.sqrt(variances[3, 3])), fits, cost)


def _make_level_rows(axes: np.ndarray, common: np.ndarray) -> list[_Rows]:
    """Rolls and, of a gimbal, pitches. axes: (N,3,3), camera to level frame. common: of all, where the fit stands."""
    down = axes[:, 1]  # in each camera's axes
    middle = np.median(down, axis=0)
    forth = np.array([0.0, -middle[2], middle[1]]) / max(float(np.hypot(middle[1], middle[2])), 1e-9)
    found = []
    for number, along in enumerate((np.array([1.0, 0, 0]), forth)):
        away, axis = down @ along - common[number], axes @ along
        slopes = np.zeros((len(down), 9))
        slopes[:, 0], slopes[:, 2], slopes[:, 7 + number] = -axis[:, 2], axis[:, 0], -1
        # Pitches differ around another vertical, so their noise is what no vertical explains.
        rest = away - slopes @ np.linalg.lstsq(slopes, away)[0] if number else away
        weights = 1 / (1 + (rest / _HELD_ASIDE) ** 2) ** 2
        variance = (weights @ rest**2 + _WORTH * ROLL**2) / (max(weights.sum() - 3, 0) + _WORTH)
        if number and (variance > _STEADY**2 or 2 * weights.sum() < len(weights)):
            break
        found.append(_Rows(slopes, away, weights / max(variance, _STEADIEST**2) * min(1, _APART / len(down))))
    return found


def _make_gps_rows(
    cameras: Cameras, rotation: np.ndarray, scale: float, shift: np.ndarray, deviations: tuple[float, float]
) -> tuple[list[_Rows], tuple[float, float], np.ndarray]:
    """East, north and down of places; their standard deviations; and by how much (N,3) they are away, in metres."""
    own = scale * cameras.centers @ rotation.T
    away = own + shift - cameras.places
    here = np.isfinite(away[:, 0])
    distances = _measure_distances(away, *deviations)
    weights = (_TAIL + 2) / (_TAIL + np.nan_to_num(distances))
    weights[~here] = 0
    (x, y, z), count = np.nan_to_num(away.T), int(here.sum())
    known = np.isfinite(away[:, 1]) * weights
    flat = (weights @ (x**2 + z**2) + 2 * _WORTH * GPS_ERROR**2) / (2 * max(count - 2, 0) + 2 * _WORTH)
    high = (known @ y**2 + _WORTH * HEIGHT_ERROR**2) / (max(int((known > 0).sum()) - 3, 0) + _WORTH)
    plane = np.column_stack([np.ones(count), own[here][:, [0, 2]]])
    lift = np.zeros(len(own))
    if count:
        lift[here] = own[here, 1] - plane @ np.linalg.lstsq(plane, own[here, 1])[0]
    east, down, north = np.zeros((3, len(own), 9))
    east[:, 1], east[:, 2], east[:, 3], east[:, 4] = own[:, 2], -lift, own[:, 0], 1
    down[:, 0], down[:, 2], down[:, 3], down[:, 5] = -own[:, 2], own[:, 0], own[:, 1], 1
    north[:, 0], north[:, 1], north[:, 3], north[:, 6] = lift, -own[:, 0], own[:, 2], 1
    flat, high = min(flat, (_WORST * GPS_ERROR) ** 2), min(high, (_WORST * HEIGHT_ERROR) ** 2)
    rows = [_Rows(east, x, weights / flat), _Rows(down, y, known / high), _Rows(north, z, weights / flat)]
    return rows, (float(np.sqrt(flat)), float(np.sqrt(high))), away


def _measure_distances(away: np.ndarray, flat: float, high: float) -> np.ndarray:
    """Squared distances (N,) of places in standard deviations; NaN without GPS."""
    return (away[:, 0] ** 2 + away[:, 2] ** 2) / flat**2 + np.nan_to_num(away[:, 1]) ** 2 / high**2
