"""Checks of lenses, units and poses by the tracks of structure from motion."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from groundwork.finding import Finding, fine, from_error
from scene.dataset_readers import CameraInfo, SceneInfo
from scene.readers.tracks import PhotoPoints, rays_to, read_tracks
from scene.reprojection import BOUND, nearest_pose, pose_loss
from utils.graphics_utils import world_to_camera
from utils.system_utils import UserError

COMPARED = 16  # views whose tracks are looked at
UNITS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)
_ADJUSTED = 0.5  # median error of points with better poses, as a part of that with the given ones,
_SEEN = 0.2  # if that is more pixels
_MOST = 0.75  # share of the views that another cause makes better
_LONGER = 0.03  # difference of a focal length that counts; tracks tell a hundredth of it
_AGREEING = 0.9  # share of the photos
_BENT = 2.0  # times the error of pairs alone, that a model's poses may have
_WRONG = 5.0  # pixels, beyond which poses are wrong even if no better ones are near
_ADJUST = "adjust the model again (COLMAP: bundle_adjuster)"
REFINE = "train with --refine_poses"  # where other poses would fit far better


def check_geometry(source: str, info: SceneInfo) -> Iterator[Finding]:
    """Check lenses by the tracks, then poses: wrong lenses would look like wrong poses."""
    views = info.train_cameras
    try:
        tracks = read_tracks(source, views, info.offset)
    except UserError as error:
        yield from_error(error)
        return
    yield from [*check_focal(views, tracks)] or check_poses(views, tracks, info.extent)


def check_focal(views: Sequence[CameraInfo], tracks: Sequence[PhotoPoints | None]) -> Iterator[Finding]:
    """Find another focal length, or another unit of the points, that fits the tracks far better."""
    step = max(1, len(views) // COMPARED)
    pairs = [pair for pair in zip(views[::step], tracks[::step], strict=True) if pair[1] is not None]
    if not pairs:
        return
    given = np.array([_measure_median_miss(view, photo) for view, photo in pairs])
    units = {k: np.array([_measure_median_miss(*pair, unit=k) for pair in pairs]) for k in UNITS}
    unit = min(units, key=lambda k: np.median(units[k]))
    # The rays are those of the given focal length, so that they are too short where that is too long.
    factor = float(np.median([_compute_focal_factor(*pair) for pair in pairs]))
    longer = np.array([_measure_median_miss(*pair, factor=factor) for pair in pairs])
    best = units[unit] if np.median(units[unit]) < np.median(longer) else longer
    if (best < _ADJUSTED * given).mean() < _MOST:
        return
    if best is longer and abs(factor - 1) > _LONGER:
        text = f"points fit the photos with focal lengths {factor:.3g} times as long as the given ones"
        yield Finding(text, "check the focal lengths and the size of the photos that they belong to")
    elif best is not longer:
        text = f"points fit the photos if those are scaled by {unit:g}: cameras and points have different units"
        yield Finding(text, f"scale the points by {unit:g}")


def _compute_focal_factor(view: CameraInfo, photo: PhotoPoints) -> float:
    """Compute the focal length that fits a photo's points best, as a factor of the given one."""
    places = np.nan_to_num(rays_to(photo.points @ view.R + view.T, photo.angular))
    return float(np.median((photo.rays * places).sum(axis=1) / np.maximum((places**2).sum(axis=1), 1e-9)))


def _measure_median_miss(view: CameraInfo, photo: PhotoPoints, unit: float = 1.0, factor: float = 1.0) -> float:
    """Median distance of points from their rays, in parts of the focal length."""
    places = rays_to(unit * photo.points @ view.R + view.T, photo.angular)
    away = np.linalg.norm(photo.rays - factor * places, axis=1)
    return float(np.median(np.where(np.isnan(away), np.inf, away)))


def pose_errors(
    views: Sequence[CameraInfo], tracks: Sequence[PhotoPoints | None], extent: float
) -> tuple[float, float] | None:
    """Median reprojection error (pixels) of COMPARED views, with given poses and with the best; None: no tracks."""
    errors, step = [], max(1, len(views) // COMPARED)
    for view, photo in zip(views[::step], tracks[::step], strict=True):
        if photo is None:
            continue
        given = world_to_camera(view.R, view.T)
        best = nearest_pose(given, photo, view.fx, extent, BOUND)
        errors.append([np.median(pose_loss(pose, photo, view.fx, extent).size) for pose in (given, best)])
    return tuple(np.median(errors, axis=0).tolist()) if errors else None


def poses_differ(given: float, best: float) -> bool:
    """Tell whether the best poses fit the tracks far better than the given ones (errors of `pose_errors`)."""
    return given > _SEEN and best < _ADJUSTED * given


def check_poses(views: Sequence[CameraInfo], tracks: Sequence[PhotoPoints | None], extent: float) -> Iterator[Finding]:
    """Find poses that are far from the best ones, which they cannot be after a bundle adjustment."""
    found = pose_errors(views, tracks, extent)
    if found is None:
        return
    given, best = found
    text = f"points lie {given:.2g} pixels from where photos show them (median)"
    if poses_differ(given, best):
        yield Finding(f"{text}, and {best:.2g} with better poses", f"{REFINE}, or {_ADJUST}")
    elif given > _WRONG:
        yield Finding(text, f"{_ADJUST}; --refine_poses corrects 3 degrees at most")


def check_agreement(folder: Path) -> Iterator[Finding]:
    """Find photos of a COLMAP model whose tracks contradict each other, as if a part of it is in a wrong place."""
    import pycolmap

    from scene.agreement import FLOOR, judge_pairs_by_tracks, verdict

    try:
        pairs = list(judge_pairs_by_tracks(pycolmap.Reconstruction(str(folder))))
    except (ValueError, RuntimeError, IndexError, OSError):
        return  # no model of COLMAP's; the readers have said what is wrong with one
    if not pairs:
        return
    photos = len({name for pair in pairs for name in (pair.first, pair.second)})
    found, side = verdict(pairs), max(pair.side for pair in pairs)
    text = f"the tracks of {found['agreeing']} of {photos} photos agree with each other"
    bent = found["error"] > max(_BENT * found["own_error"], FLOOR * side)
    if bent or found["agreeing"] < _AGREEING * photos:
        errors = f"{found['error']:.2g} pixels by the poses and {found['own_error']:.2g} by pairs alone"
        yield Finding(f"only {text} (errors of {errors})", "compute the poses again, with convert.py or more photos")
    else:
        yield fine(text)
