"""Checks of a dataset, through the project's own readers: whether it can be trained, and what will harm the result."""

import contextlib
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from scene.check import findings
from scene.dataset_readers import CameraInfo, SceneInfo, read_scene
from scene.images.exif import read_lens
from scene.pose_errors import ADJUSTED, COMPARED, pose_errors, poses_differ
from scene.readers.info import NEAREST
from scene.readers.tracks import Track, enlargement, rays_to, read_tracks
from splatting.diagnosis import Line, from_error
from splatting.diagnosis.colors import UNITS, check_colors
from splatting.files.json_files import read_json
from splatting.host.listing import some
from splatting.registry import tools
from utils.system_utils import UserError

# Learning rates and size limits are fractions of the extent, but depths below 0.2 are culled and float32 is used.
EXTENT = (1e-3, 1e4)  # photos of 4.8 score the same within seeds at 0.0048 and 4,800
FEWEST_VIEWS = 20
FEWEST_POINTS = 1000
REGISTERED = 0.9  # share of the photos
MOST_PHOTOS = 100  # that are decoded
_WIDE = 1600
_MOST = 0.75  # share of the views that another cause makes better
_LONGER = 0.03  # difference of a focal length that counts; tracks tell a hundredth of it
_ADJUST = "adjust the model again (COLMAP: bundle_adjuster)"
_BENT = 2.0  # times the error of pairs alone, that a model's poses may have
_WRONG = 5.0  # pixels, beyond which poses are wrong even if no better ones are near


def check_dataset(source: str, images: str) -> list[Line]:
    """Lines about the dataset in a folder. images: as train.py's -i."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            info = read_scene(source, images, hold_out=False, native=True)
    except UserError as error:
        return [*_warnings(said.getvalue()), from_error(error)]
    views = info.train_cameras
    found = findings(info, MOST_PHOTOS)
    checks = [
        check_views(views),
        check_lenses(source, views),
        check_extent(info),
        check_cloud(info),
        [Line(*one[:2]) for one in found],
    ]
    if not any(one.of_lens for one in found):  # else poses and colours have that cause
        checks += [check_geometry(source, info), check_agreement(Path(source) / "sparse" / "0")]
    return [*_warnings(said.getvalue()), *chain(*checks, _check_registered(Path(source) / "convert_report.json"))]


def check_views(cameras: list[CameraInfo]) -> Iterator[Line]:
    """Number and sizes of the photos."""
    sizes = Counter(camera.file_size for camera in cameras)
    listed = ", ".join(f"{w} x {h} ({n})" for (w, h), n in sizes.most_common(3))
    listed += f" and {len(sizes) - 3} more sizes" if len(sizes) > 3 else ""
    yield Line(f"{len(cameras)} photos, none missing and all readable: {listed}")
    if len(cameras) < FEWEST_VIEWS:
        yield Line(f"only {len(cameras)} photos", f"take {FEWEST_VIEWS} or more; new views will look bad with fewer")
    if wide := sum(n for (width, _), n in sizes.items() if width > _WIDE):
        yield Line(f"{wide} photos are wider than {_WIDE} pixels and train at that width unless -r 1 is given")


def check_lenses(source: str, views: Sequence[CameraInfo]) -> Iterator[Line]:
    """Photos that share a camera although their EXIF data tell different focal lengths."""
    shared: dict[tuple, Counter[float]] = {}
    for view in views:
        # Programs that undistort photos keep few EXIF data: convert.py has the photos themselves in `input`.
        lens = read_lens(view.image_path)
        lens = lens if lens.length else read_lens(Path(source, "input", view.image_name))
        key = view.width, view.height, view.fx, view.fy, view.cx, view.cy
        shared.setdefault(key, Counter())[lens.length] += 1
    for lengths in shared.values():
        found = sorted(length for length in lengths if length)
        if found and found[-1] > (1 + _LONGER) * found[0]:
            listed = some([f"{length:g} mm ({lengths[length]})" for length in found])
            yield Line(
                f"{lengths.total()} photos share one camera, but their EXIF data tell several focal lengths: {listed}",
                "convert them again with convert.py --cameras per_lens, or let the program that made the cameras "
                "give each lens its own",
            )


def check_extent(info: SceneInfo) -> Iterator[Line]:
    """Scale of the scene."""
    low, high = EXTENT
    if low <= info.extent <= high:
        factor = enlargement(info)
        near = f", so depths from {NEAREST / factor:.2g} on are drawn" if factor != 1 else ""
        yield Line(f"extent {info.extent:.3g}{near}")
    else:
        remedy = f"scale cameras and points by {10.0 ** round(np.log10(5 / info.extent)):g}"
        yield Line(f"the extent is {info.extent:.3g}, outside {low:g} to {high:g}", remedy)


def check_cloud(info: SceneInfo) -> Iterator[Line]:
    """Number of points."""
    text = f"{len(info.point_cloud.points)} points to start from"
    if len(info.point_cloud.points) < FEWEST_POINTS:
        more = "start from more points (--init_pcd_path), or reconstruct with more photos or features"
        yield Line(f"only {text}; {FEWEST_POINTS} or more are good", more)
    else:
        yield Line(text)


def check_geometry(source: str, info: SceneInfo) -> Iterator[Line]:
    """Lenses and poses beside the tracks, then colours: wrong lenses or poses would look like wrong photos."""
    views = info.train_cameras
    try:
        tracks = read_tracks(source, views, info.offset)
    except UserError as error:
        yield from_error(error)
        tracks = [None] * len(views)
    lines = [*check_focal(views, tracks)] or [*check_poses(views, tracks, info.extent)]
    yield from lines or check_colors(info, tracks)


def check_focal(views: Sequence[CameraInfo], tracks: Sequence[Track | None]) -> Iterator[Line]:
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
    if (best < ADJUSTED * given).mean() < _MOST:
        return
    if best is longer and abs(factor - 1) > _LONGER:
        text = f"points fit the photos with focal lengths {factor:.3g} times as long as the given ones"
        yield Line(text, "check the focal lengths and the size of the photos that they belong to")
    elif best is not longer:
        text = f"points fit the photos if those are scaled by {unit:g}: cameras and points have different units"
        yield Line(text, f"scale the points by {unit:g}")


def _longer(view: CameraInfo, track: Track) -> float:
    """The focal length that fits a track best, by the given one."""
    places = np.nan_to_num(rays_to(track.points @ view.R + view.T, track.angular))
    return float(np.median((track.rays * places).sum(axis=1) / np.maximum((places**2).sum(axis=1), 1e-9)))


def _missed(view: CameraInfo, track: Track, unit: float = 1.0, factor: float = 1.0) -> float:
    """Median distance of points from their rays, in parts of the focal length."""
    places = rays_to(unit * track.points @ view.R + view.T, track.angular)
    away = np.linalg.norm(track.rays - factor * places, axis=1)
    return float(np.median(np.where(np.isnan(away), np.inf, away)))


def check_poses(views: Sequence[CameraInfo], tracks: Sequence[Track | None], extent: float) -> Iterator[Line]:
    """Tracks that other poses fit far better than the given ones, as after a bundle adjustment they cannot."""
    found = pose_errors(views, tracks, extent)
    if found is None:
        return
    given, best = found
    text = f"points lie {given:.2g} pixels from where photos show them (median)"
    if poses_differ(given, best):
        remedies = [*(remedy(True) for remedy in tools("for_wrong_poses")), _ADJUST]
        yield Line(f"{text}, and {best:.2g} with better poses", ", or ".join(remedies))
    elif given > _WRONG:
        yield Line(text, "; ".join([_ADJUST, *(remedy(False) for remedy in tools("for_wrong_poses"))]))


def check_agreement(folder: Path) -> Iterator[Line]:
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
    if bent or found["agreeing"] < REGISTERED * photos:
        errors = f"{found['error']:.2g} pixels by the poses and {found['own_error']:.2g} by pairs alone"
        yield Line(f"only {text} (errors of {errors})", "compute the poses again, with convert.py or more photos")
    else:
        yield Line(text)


def _check_registered(path: Path) -> Iterator[Line]:
    """Line of convert.py's report, if convert.py made the scene."""
    if not path.is_file():
        return
    try:
        report = read_json(path)
        placed, photos = int(report["registered"]), int(report["photos"])
        advice = [str(line) for line in report["advice"]]
    except (OSError, ValueError, KeyError, TypeError):
        yield Line(f"{path} is damaged", "remove it, or run convert.py again")
        return
    text = f"{placed} of {photos} photos were placed by convert.py"
    remedy = advice[0].rpartition("; ")[2] if advice else "take more photos that overlap"
    few = photos and placed / photos < REGISTERED
    yield Line(f"only {text}", remedy) if few else Line(text)


def _warnings(said: str) -> list[Line]:
    """Notes of the messages that the readers printed, without progress bars."""
    texts = [text.strip() for text in said.replace("\r", "\n").splitlines() if text.strip() and "%|" not in text]
    return [Line(text, note=True) for text in texts]
