"""Orientation of a converted scene: its vertical, and the length of a metre in it (convert.py --orient).

The vertical is that of gravity in photos' EXIF data, else that of the photos' horizons and GPS, if they tell it. GPS
gives the metre and the north. In the frame that results, y is down; with GPS, x is east and z is north.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from applications.convert.georeference import Cameras, Fit, fit_level_frame, is_level
from applications.convert.layout import Layout
from groundwork.files.json_files import write_json
from groundwork.files.similarity import PLACE, read_orientation
from scene.images.exif import PhotoPlace, read_place
from scene.readers.colmap import read_model

FEWEST = 3  # photos with a GPS place
_SIZE = 0.1  # standard error of the scale, above which GPS does not tell it
_AGREE = np.cos(np.radians(30))  # of gravity in a photo with that in most others, and with the vertical of horizons


def orient_scene(layout: Layout) -> None:
    """Write the similarity of a converted scene, `layout.orientation`; where no vertical is known, only the scale."""
    images = sorted(read_model(layout.sparse / "0").images, key=lambda image: image.name)
    turns = np.stack([image.qvec2rotmat().T for image in images])
    centers = np.stack([-turn @ image.tvec for turn, image in zip(turns, images, strict=True)])
    photos = [read_place(_find_source_photo(layout, image.name)) for image in images]
    middle, (reference, places) = np.median(centers, axis=0), _locate_photos(photos)
    cameras = Cameras(turns, centers - middle, places)
    vertical, found = _find_vertical(cameras, photos)
    record: dict[str, Any] = {"unit": "scene", "gps_seen": int(np.isfinite(places[:, 0]).sum())} | vertical
    rotation, scale = found.rotation if vertical["vertical"] else np.eye(3), 1.0
    if _is_metric(found, cameras):
        scale = found.scale
        record |= {"unit": "metre", "scale_error": found.size, "gps_photos": int(found.fits.sum())}
        record |= {"gps_error": _estimate_gps_error(found, cameras)} | (
            _locate_middle(found, reference) if vertical["vertical"] else {}
        )
    translation = -scale * rotation @ middle
    record |= {"rotation": rotation.tolist(), "scale": scale, "translation": translation.tolist()}
    write_json(layout.orientation, record)


def describe_orientation(layout: Layout) -> list[str]:
    """Say in a line what orientation `orient_scene` found; no line if --orient was not given."""
    if (record := read_orientation(layout.scene)) is None:
        return []
    if record["vertical"] is None:
        level = (
            "upright: not known, as neither the photos' horizons nor GPS tell it; add photos to several sides, or GPS"
        )
    else:
        turn = np.degrees(np.arccos(np.clip(record["rotation"][1][1], -1, 1)))
        error = record.get("vertical_error")
        level = f"upright: tilted by {turn:.1f} degrees{f' (to {error:.1f})' if error else ''}, by {record['vertical']}"
    if record["unit"] == "metre":
        if "gps_photos" not in record:
            return [f"{level}; a unit is {record['scale']:.4g} m, as measured in the viewer"]
        error = f" (to {record['scale_error']:.1%})" if "scale_error" in record else ""
        used = f"GPS of {record['gps_photos']} photos, which fit to {record['gps_error']:.2g} m"
        return [f"{level}; a unit is {record['scale']:.4g} m{error} by {used}"]
    if (seen := record.get("gps_seen", 0)) < FEWEST:
        return [f"{level}; no scale: it needs {FEWEST} photos with GPS, and has {seen}"]
    return [f"{level}; no scale: GPS of {seen} photos is too near to each other, or does not fit the poses"]


def _find_vertical(cameras: Cameras, photos: Sequence[PhotoPlace]) -> tuple[dict[str, Any], Fit]:
    """Return the entries on the vertical for `layout.orientation`, and the fit with this vertical.

    GPS counts only where neither gravity nor horizons tell the vertical: the heights of phones are all wrong by the
    same many metres.
    """
    level = fit_level_frame(cameras._replace(places=np.full_like(cameras.places, np.nan)))
    if measured := _measure_up(cameras.turns, level, photos):
        up, text = measured
        return {"vertical": text}, fit_level_frame(cameras, up)
    if is_level(level):
        error, up = float(np.degrees(level.tilt)), -level.rotation[1]
        return {"vertical": f"the horizons of {len(photos)} photos", "vertical_error": error}, fit_level_frame(
            cameras, up
        )
    found = fit_level_frame(cameras)
    if not (_is_metric(found, cameras) and is_level(found)):
        return {"vertical": None}, found
    horizons = f"the horizons of {len(photos)} photos and " if found.by_level < 2 * found.tilt else ""
    text = f"{horizons}GPS of {found.fits.sum()} photos"
    return {"vertical": text, "vertical_error": float(np.degrees(found.tilt))}, found


def _is_metric(found: Fit, cameras: Cameras) -> bool:
    """Tell if GPS gives the scale: enough photos have it, and most of these fit."""
    return found.size < _SIZE and found.fits.sum() >= max(FEWEST, np.isfinite(cameras.places[:, 0]).sum() / 2)


def _locate_photos(photos: Sequence[PhotoPlace]) -> tuple[np.ndarray, np.ndarray]:
    """Return a place on Earth (degrees, degrees, m) amid the photos, and their places relative to it.

    The places are (N, 3), metres east, down and north; NaN where unknown. Heights that are all equal count as unknown,
    since GPS does not measure such heights.
    """
    gps = np.array([photo.gps or (np.nan,) * 3 for photo in photos])
    here = np.isfinite(gps[:, 0])
    places, heights = np.full_like(gps, np.nan), gps[np.isfinite(gps[:, 2]), 2]
    if not here.any():
        return np.zeros(3), places
    filled = np.where(np.isfinite(gps[here]), gps[here], np.median(heights) if len(heights) else 0.0)
    earth = _find_earth()
    # Not the median of degrees, which is far away from photos around a pole or at a longitude of 180 degrees.
    reference = earth.ecef_to_ellipsoid(np.median(earth.ellipsoid_to_ecef(filled), axis=0)[None])[0]
    places[here] = earth.ellipsoid_to_enu(filled, *reference)[:, [0, 2, 1]] * [1, -1, 1]
    places[np.isnan(gps[:, 2]) | (len(set(heights)) < 2), 1] = np.nan
    return reference, places


def _find_earth() -> Any:
    import pycolmap

    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


def _estimate_gps_error(found: Fit, cameras: Cameras) -> float:
    """Return the mean distance along the ground, in metres, of the places that fit from their GPS."""
    away = found.scale * cameras.centers @ found.rotation.T + found.shift - cameras.places
    return float(np.hypot(away[found.fits, 0], away[found.fits, 2]).mean())


def _locate_middle(found: Fit, reference: np.ndarray) -> dict[str, float]:
    """Return the place on Earth of the middle of the photos."""
    east, down, north = found.shift
    place = _find_earth().enu_to_ellipsoid(np.array([[east, north, -down]]), *reference)[0]
    return dict(zip(PLACE, place.tolist(), strict=True))


def _measure_up(turns: np.ndarray, level: Fit, photos: Sequence[PhotoPlace]) -> tuple[np.ndarray, str] | None:
    """Return the upward direction (3,) by gravity in the photos' EXIF data, and a text on its source.

    None if no photo has gravity, or if most photos contradict each other or the known vertical.
    """
    having = [number for number, photo in enumerate(photos) if photo.down is not None]
    if not having:
        return None
    ups = np.stack([-turns[number] @ photos[number].down for number in having])
    most = -level.rotation[1] if is_level(level) else np.median(ups, axis=0)
    ups = ups[ups @ most > _AGREE * np.linalg.norm(most)]
    if 2 * len(ups) <= len(having):
        return None
    up = np.median(ups, axis=0)
    return up / np.linalg.norm(up), f"gravity of {len(ups)} photos"


def _find_source_photo(layout: Layout, name: str) -> Path:
    """Return the file that a photo of the model was made from, which still has all EXIF data."""
    kept = layout.input / name
    changed = kept.with_name(kept.stem)  # without the suffix that was appended for COLMAP
    return next((path for path in (kept, changed) if path.is_file()), layout.images / name)
