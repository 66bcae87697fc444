"""Where a converted scene is upright, and how large a metre is in it (convert.py --orient).

The vertical is that of gravity in photos' EXIF data, else that of the cameras' horizons. GPS places in EXIF data give
the metre and the north. In the frame that results, y is down; with GPS, x is east and z is north.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scene.images.place import PhotoPlace, read_place
from scene.readers.colmap import read_model
from splatting.files.json_files import write_json
from splatting.files.similarity import read_orientation
from splatting.sfm.layout import Layout

FEWEST = 3  # photos with a GPS place
_GPS_ERROR = 5.0  # metres; that of a phone under open sky
_NOISE = 0.3  # largest mean error of places, as a share of their mean distance from the middle
_PAIRS = 2000  # of photos, whose similarity is tried
_MEAN_UP = 0.01  # weight of the mean up beside the horizons
_ROUNDS = 20
_ROLL = 0.05  # radians; a usual roll of a camera that is held level
_AGREE = np.cos(np.radians(30))  # of gravity with the cameras' own up


class Georeference(NamedTuple):
    """Of GPS. scale: metres for a unit. heading: complex, of length 1, by which levelled x + i z turns to east and
    north. error: mean of the places, metres. origin: latitude and longitude (degrees), height (m) of the middle."""

    scale: float
    heading: complex
    error: float
    used: int
    origin: tuple[float, float, float]


def orient(layout: Layout) -> None:
    """Write the similarity of a converted scene, `layout.orientation`."""
    images = sorted(read_model(layout.sparse / "0").images, key=lambda image: image.name)
    to_camera = np.stack([image.qvec2rotmat() for image in images])
    turns = to_camera.transpose(0, 2, 1)
    centers = np.stack([-turn @ image.tvec for turn, image in zip(turns, images, strict=True)])
    places = [read_place(_photo(layout, image.name)) for image in images]
    level, said = level_up(turns), f"the horizons of {len(images)} photos"
    if (measured := _measured_up(turns, level, places)) is not None:
        level, said = measured
    rotation = _upright(level)
    middle = np.median(centers, axis=0)
    gps = georeference((centers - middle) @ rotation.T, places)
    scale = 1.0
    record: dict[str, Any] = {"vertical": said, "unit": "scene"}
    if gps:
        c, s = gps.heading.real, gps.heading.imag
        rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ rotation
        scale = gps.scale
        latitude, longitude, height = gps.origin
        record |= {"unit": "metre", "gps_photos": gps.used, "gps_error": gps.error}
        record |= {"latitude": latitude, "longitude": longitude, "height": height}
    translation = -scale * rotation @ middle
    record |= {"rotation": rotation.tolist(), "scale": scale, "translation": translation.tolist()}
    write_json(layout.orientation, record)


def said_of(layout: Layout) -> list[str]:
    """A line on what `orient` found; none if it was not asked for."""
    if (record := read_orientation(layout.scene)) is None:
        return []
    turn = np.degrees(np.arccos(np.clip(record["rotation"][1][1], -1, 1)))
    if record["unit"] == "metre":
        error, used = record["gps_error"], record["gps_photos"]
        metric = f"a unit is {record['scale']:.4g} m by GPS of {used} photos, which fit to {error:.2g} m"
    else:
        metric = f"no scale: fewer than {FEWEST} photos with GPS, or their places are too near to each other"
    return [f"upright: tilted by {turn:.1f} degrees, by {record['vertical']}; {metric}"]


def level_up(turns: np.ndarray) -> np.ndarray:
    """The direction (3,), of length 1, that is up for most cameras: the one in which their rolls are least.

    turns: (N,3,3), from camera to world axes. A level camera has its x axis at right angles to up. So up is the
    eigenvector of the least eigenvalue of the weighted mean of x x^T. Weights are Cauchy's, 1 / (1 + (roll / _ROLL)^2),
    so that photos held aside hardly count. Where cameras face one way, their mean up decides.
    """
    across, ups = turns[:, :, 0], -turns[:, :, 1]
    weights = np.ones(len(turns))
    for _ in range(_ROUNDS):
        mean = weights @ ups
        mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
        matrix = (weights[:, None] * across).T @ across / weights.sum() + _MEAN_UP * (np.eye(3) - np.outer(mean, mean))
        up = np.linalg.eigh(matrix)[1][:, 0]
        up = up if up @ mean >= 0 else -up
        weights = 1 / (1 + (across @ up / _ROLL) ** 2)
    return up


def _measured_up(turns: np.ndarray, level: np.ndarray, places: Sequence[PhotoPlace]) -> tuple[np.ndarray, str] | None:
    """Up by gravity of the photos that have it, and what is said of it; None if none has, or it contradicts most."""
    having = [number for number, place in enumerate(places) if place.down is not None]
    if not having:
        return None
    ups = np.stack([-turns[number] @ places[number].down for number in having])
    ups = ups[ups @ level > _AGREE]
    if 2 * len(ups) <= len(having):
        return None
    up = np.median(ups, axis=0)
    return up / np.linalg.norm(up), f"gravity of {len(ups)} photos"


def _upright(up: np.ndarray) -> np.ndarray:
    """The least rotation (3,3) that takes a direction to -y."""
    from scipy.spatial.transform import Rotation

    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -float(up[1])
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix()


def georeference(levelled: np.ndarray, places: Sequence[PhotoPlace]) -> Georeference | None:
    """Scale and north of levelled camera centres (N,3), y down, by the horizontal places that GPS gives the photos.

    Places that do not fit are left out. None if fewer than FEWEST are left, or than half of them, or if
    they are so near to each other that their errors decide.
    """
    import pycolmap

    having = [number for number, place in enumerate(places) if place.gps is not None]
    if len(having) < FEWEST:
        return None
    gps = np.array([places[number].gps for number in having])
    reference = np.median(gps, axis=0)
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    east_north_up = earth.ellipsoid_to_enu(gps, *reference)
    own = levelled[having, 0] + 1j * levelled[having, 2]
    true = east_north_up[:, 0] + 1j * east_north_up[:, 1]
    kept = _consensus(own, true)
    if len(kept) < max(FEWEST, len(having) / 2):
        return None
    own, true = own[kept], true[kept]
    own_middle, true_middle = own.mean(), true.mean()
    size = float((np.abs(own - own_middle) ** 2).sum())
    if size == 0:
        return None
    factor = (np.conj(own - own_middle) @ (true - true_middle)) / size  # least squares for true = factor * own
    error, spread = (
        float(np.abs(values).mean())
        for values in (true - true_middle - factor * (own - own_middle), true - true_middle)
    )
    if abs(factor) == 0 or spread < _GPS_ERROR or error > _NOISE * spread:
        return None
    middle = true_middle - factor * own_middle
    height = np.median(east_north_up[kept, 2] + abs(factor) * levelled[having][kept, 1])
    origin = earth.enu_to_ellipsoid(np.array([[middle.real, middle.imag, height]]), *reference)[0]
    return Georeference(abs(factor), factor / abs(factor), error, len(kept), tuple(origin.tolist()))


def _consensus(own: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Indices of the most places that one similarity of the plane takes to within _GPS_ERROR of their GPS.

    own, true: (N,) complex. Similarities true = a own + b are tried that two photos determine. pycolmap's robust
    alignment finds none where heights are equal, as they are without altitudes.
    """
    first, second = np.triu_indices(len(own), 1)
    if len(first) > _PAIRS:
        chosen = np.random.default_rng(0).choice(len(first), _PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    apart = own[second] - own[first]
    known = np.abs(apart) > 1e-9 * np.abs(own).max()
    best = np.zeros(0, int)
    for i, j in zip(first[known], second[known], strict=True):
        factor = (true[j] - true[i]) / (own[j] - own[i])
        near = np.flatnonzero(np.abs(true - true[i] - factor * (own - own[i])) <= _GPS_ERROR)
        best = near if len(near) > len(best) else best
    return best


def _photo(layout: Layout, name: str) -> Path:
    """The file that a photo of the model was made from, which has all of its EXIF data."""
    kept = layout.input / name
    changed = kept.with_name(kept.stem)  # without the suffix that was appended for COLMAP
    return next((path for path in (kept, changed) if path.is_file()), layout.images / name)
