"""Whether cameras, points and photos fit together: by the tracks of structure from motion, then by colours.

A photo fits its camera if it shows the colours of the camera's points better than most other photos do. That needs no
threshold of colour, and holds for any exposure.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene.dataset_readers import CameraInfo, SceneInfo
from scene.readers.tracks import Track, projected, rays_to, read_tracks
from scene.reprojection import BOUND, nearest_pose, pull
from splatting.findings import Finding, fine, from_error
from splatting.findings.photo_files import small
from splatting.host.listing import some
from splatting.registry import tools
from utils.graphics_utils import BasicPointCloud, world_to_camera
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
_SAMPLE = 5000  # most points
_FEWEST = 10  # points in a photo, and in all
_GREY = 0.02  # spread of colours, below which they tell nothing
_RANDOM = 0.9  # difference of neighbours' colours by that of any two points, above which they are random
_FEW = 8  # photos, of which chance may say anything
_OTHERS = 24  # photos that a photo is compared with
_BETTER = 0.9  # share of these, than which a photo has to fit better
_TOGETHER, _APART = 0.75, 0.5  # share of photos that fit, above which all fit together, and below which they do not
_SAME = 1e-4  # extents between a point and itself
_CAMERAS = 16  # that geometric causes are tried on
_PHOTOS, _SMALL = 400, 200  # most photos that are compared, and their size in pixels
_SUSPECTS = 24  # photos that fit their cameras worst
_CLEARLY = 0.8  # error with another cause or photo, as a part of the given one's
_FOCAL = (0.5, 0.6, 0.75, 0.87, 1.15, 1.33, 1.7, 2.0)


def check_geometry(source: str, info: SceneInfo) -> Iterator[Finding]:
    """Lenses and poses beside the tracks, then colours: wrong lenses or poses would look like wrong photos."""
    views = info.train_cameras
    try:
        tracks = read_tracks(source, views, info.offset)
    except UserError as error:
        yield from_error(error)
        tracks = [None] * len(views)
    lines = [*check_focal(views, tracks)] or [*check_poses(views, tracks, info.extent)]
    yield from lines or check_colors(info, tracks)


def check_focal(views: Sequence[CameraInfo], tracks: Sequence[Track | None]) -> Iterator[Finding]:
    """Another focal length, or another unit of the points, with which the tracks fit far better."""
    step = max(1, len(views) // COMPARED)
    pairs = [pair for pair in zip(views[::step], tracks[::step], strict=True) if pair[1] is not None]
    if not pairs:
        return
    given = np.array([_missed(view, track) for view, track in pairs])
    units = {k: np.array([_missed(*pair, unit=k) for pair in pairs]) for k in UNITS}
    unit = min(units, key=lambda k: np.median(units[k]))
    # The rays are those of the given focal length, so that they are too short where that is too long.
    factor = float(np.median([_longer(*pair) for pair in pairs]))
    longer = np.array([_missed(*pair, factor=factor) for pair in pairs])
    best = units[unit] if np.median(units[unit]) < np.median(longer) else longer
    if (best < _ADJUSTED * given).mean() < _MOST:
        return
    if best is longer and abs(factor - 1) > _LONGER:
        text = f"points fit the photos with focal lengths {factor:.3g} times as long as the given ones"
        yield Finding(text, "check the focal lengths and the size of the photos that they belong to")
    elif best is not longer:
        text = f"points fit the photos if those are scaled by {unit:g}: cameras and points have different units"
        yield Finding(text, f"scale the points by {unit:g}")


def _longer(view: CameraInfo, track: Track) -> float:
    """The focal length that fits a track best, by the given one."""
    places = np.nan_to_num(rays_to(track.points @ view.R + view.T, track.angular))
    return float(np.median((track.rays * places).sum(axis=1) / np.maximum((places**2).sum(axis=1), 1e-9)))


def _missed(view: CameraInfo, track: Track, unit: float = 1.0, factor: float = 1.0) -> float:
    """Median distance of points from their rays, in parts of the focal length."""
    places = rays_to(unit * track.points @ view.R + view.T, track.angular)
    away = np.linalg.norm(track.rays - factor * places, axis=1)
    return float(np.median(np.where(np.isnan(away), np.inf, away)))


def pose_errors(
    views: Sequence[CameraInfo], tracks: Sequence[Track | None], extent: float
) -> tuple[float, float] | None:
    """Pixels from points to where photos show them (median), with their poses and with the best ones; None: no tracks.

    Of COMPARED views.
    """
    errors, step = [], max(1, len(views) // COMPARED)
    for view, track in zip(views[::step], tracks[::step], strict=True):
        if track is None:
            continue
        given = world_to_camera(view.R, view.T)
        best = nearest_pose(given, track, view.fx, extent, BOUND)
        errors.append([np.median(pull(pose, track, view.fx, extent).size) for pose in (given, best)])
    return tuple(np.median(errors, axis=0).tolist()) if errors else None


def poses_differ(given: float, best: float) -> bool:
    """Whether better poses fit the tracks far better (`pose_errors`)."""
    return given > _SEEN and best < _ADJUSTED * given


def check_poses(views: Sequence[CameraInfo], tracks: Sequence[Track | None], extent: float) -> Iterator[Finding]:
    """Tracks that other poses fit far better than the given ones, as after a bundle adjustment they cannot."""
    found = pose_errors(views, tracks, extent)
    if found is None:
        return
    given, best = found
    text = f"points lie {given:.2g} pixels from where photos show them (median)"
    if poses_differ(given, best):
        remedies = [*(remedy(True) for remedy in tools("for_wrong_poses")), _ADJUST]
        yield Finding(f"{text}, and {best:.2g} with better poses", ", or ".join(remedies))
    elif given > _WRONG:
        yield Finding(text, "; ".join([_ADJUST, *(remedy(False) for remedy in tools("for_wrong_poses"))]))


def check_agreement(folder: Path) -> Iterator[Finding]:
    """Photos of a COLMAP model whose tracks contradict each other, as where a part of it is in a wrong place."""
    import pycolmap

    from scene.agreement import FLOOR, pairs_by_tracks, verdict

    try:
        pairs = list(pairs_by_tracks(pycolmap.Reconstruction(str(folder))))
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


class _Photos(NamedTuple):
    """Cameras and their photos, (H, W, 3) in [0, 1], and the points that they see."""

    cameras: Sequence[CameraInfo]
    pixels: Sequence[np.ndarray]
    cloud: BasicPointCloud


def check_colors(info: SceneInfo, tracks: Sequence[Track | None] = ()) -> Iterator[Finding]:
    """What does not fit together, if photos have other colours than the points that they should show.

    tracks: of the cameras, which fit them.
    """
    step = max(1, len(info.point_cloud.points) // _SAMPLE)
    cloud = BasicPointCloud(*(values[::step] for values in info.point_cloud))
    if len(cloud.points) < _FEWEST or cloud.colors.std(axis=0).max() < _GREY:
        return
    step = -(-len(info.train_cameras) // _PHOTOS)
    cameras = info.train_cameras[::step]
    photos = _Photos(cameras, [small(camera.image_path, _SMALL) / 255 for camera in cameras], cloud)
    if wrong := [*_geometric(photos)]:
        yield wrong[0]
    elif (fit := _fitting(photos)) is None:
        return
    elif fit.mean() < _APART and not _are_random(cloud):
        text = f"{(~fit).sum()} of {len(fit)} photos show the points of their camera no better than other photos do"
        yield Finding(*_apart(info, [track.points for track in tracks if track], text))
    elif fit.mean() > _TOGETHER:
        yield from _strange(photos)


def _nearest(points: np.ndarray, places: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Distances from places to the nearest of points (N, 3), and their indices; count: how many of them."""
    from scipy.spatial import KDTree  # it takes a while to import

    return KDTree(points).query(places, k=count)


def _are_random(cloud: BasicPointCloud) -> bool:
    """Whether colours are those of a cloud that is made up, as for scenes without points."""
    neighbours = _nearest(cloud.points, cloud.points, count=2)[1][:, 1]
    others = np.random.default_rng(0).permutation(len(neighbours))
    near, far = (np.abs(cloud.colors - cloud.colors[chosen]).mean() for chosen in (neighbours, others))
    return bool(near > _RANDOM * far)


def _fitting(photos: _Photos) -> np.ndarray | None:
    """Of each photo whether it fits its camera, but for cameras that see few points; None of too few to tell."""
    count, fit = len(photos.cameras), []
    for n, camera in enumerate(photos.cameras):
        others = [k for k in np.linspace(0, count - 1, min(count, _OTHERS)).astype(int) if k != n]
        own, *errors = _errors(camera, [photos.pixels[k] for k in (n, *others)], photos.cloud)
        if np.isfinite(own):
            fit.append(np.mean(own < np.array(errors)) >= _BETTER)
    return np.array(fit) if len(fit) >= _FEW else None


def _apart(info: SceneInfo, seen: Sequence[np.ndarray], text: str) -> tuple[str, str]:
    """Which of the three do not fit, and the remedy. seen: points of tracks, which fit the cameras."""
    if not seen:
        remedy = "check that all are of one reconstruction: axes and unit of the points, names of the photos"
        return f"cameras and points, or cameras and photos, do not fit together: {text}", remedy
    away = _nearest(info.point_cloud.points, np.concatenate(seen)[:: max(1, sum(map(len, seen)) // _SAMPLE)])[0]
    if np.median(away) > _SAME * (info.extent or 1.0):
        remedy = "start from the points of the cameras' own reconstruction, in its axes and unit"
        return f"cameras and points do not fit together: {text}", remedy
    remedy = "restore the photos that the cameras were computed from, under their names, or name their folder by -i"
    return f"cameras and photos do not fit together: {text}", remedy


def _errors(camera: CameraInfo, photos: Sequence[np.ndarray], cloud: BasicPointCloud) -> np.ndarray:
    """Mean differences of colour between the points that a camera sees and photos, without that of the exposure."""
    x, y, inside = projected(camera, cloud.points)
    if inside.sum() < _FEWEST:
        return np.full(len(photos), np.inf)
    x, y, colors, errors = x[inside] / camera.width, y[inside] / camera.height, cloud.colors[inside], []
    for photo in photos:
        height, width = photo.shape[:2]
        apart = photo[(y * height).astype(int), (x * width).astype(int)] - colors
        errors.append(np.abs(apart - np.median(apart, axis=0)).mean())
    return np.array(errors)


def _geometric(photos: _Photos) -> Iterator[Finding]:
    """Another focal length, or another unit of the points, with which most photos fit clearly better."""
    step = -(-len(photos.cameras) // _CAMERAS)
    some_of = _Photos(photos.cameras[::step], photos.pixels[::step], photos.cloud)
    focal = {k: some_of._replace(cameras=[_refocused(c, k) for c in some_of.cameras]) for k in _FOCAL}
    units = {k: some_of._replace(cloud=some_of.cloud._replace(points=k * some_of.cloud.points)) for k in UNITS}
    given = _own(some_of)
    found = [
        (name, k, _own(other), other) for name, tried in (("f", focal), ("u", units)) for k, other in tried.items()
    ]
    name, factor, errors, other = min(found, key=lambda one: np.median(one[2]))
    fit = _fitting(other)
    if not (errors < _CLEARLY * given).mean() >= _MOST or (fit is not None and fit.mean() < _TOGETHER):
        return
    if name == "f":
        text = f"photos fit the points with focal lengths about {factor:g} times as long"
        yield Finding(text, "check the focal lengths and the size of the photos that they belong to")
    else:
        text = f"photos fit the points if those are scaled by {factor:g}: cameras and points have different units"
        yield Finding(text, f"scale the points by {factor:g}")


def _refocused(camera: CameraInfo, factor: float) -> CameraInfo:
    if camera.native:
        return camera  # its distortion would have to change, too
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def _own(photos: _Photos) -> np.ndarray:
    pairs = zip(photos.cameras, photos.pixels, strict=True)
    return np.array([_errors(camera, [pixels], photos.cloud)[0] for camera, pixels in pairs])


def _strange(photos: _Photos) -> Iterator[Finding]:
    """Photos of whose camera another photo shows clearly more, and clearly more than of its own camera."""
    own = _own(photos)
    suspects = np.argsort(np.where(np.isfinite(own), -own, 0))[:_SUSPECTS]
    shapes = np.array([camera.width / camera.height for camera in photos.cameras])
    found = []
    for n in suspects:
        errors = _errors(photos.cameras[n], photos.pixels, photos.cloud)
        errors[~np.isclose(shapes, shapes[n], rtol=0.02)] = np.inf
        best = int(errors.argmin())
        if errors[best] < _CLEARLY * min(own[n], own[best]):
            found.append(photos.cameras[n].image_name)
    if found:
        count = f"{len(found)} of {len(own)} photos"
        text = f"cameras and photos do not fit together: {count} do not show their points ({some(sorted(found))})"
        yield Finding(text, "restore the photos that these cameras were computed from, under their names")
