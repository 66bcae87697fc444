"""Checks of a dataset, through the project's own readers: whether it can be trained, and what will harm the result."""

import contextlib
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from scene.dataset_readers import CameraInfo, SceneInfo, read_scene
from scene.readers.info import APART, camera_centers, standing_apart
from scene.readers.tracks import Track, projected, read_tracks
from scene.reprojection import BOUND, nearest_pose, pull
from splatting.diagnosis import Line, from_error
from splatting.files.json_files import read_json
from splatting.files.listing import some
from utils.graphics_utils import BasicPointCloud, world_to_camera
from utils.system_utils import UserError

# Learning rates and size limits are fractions of the extent, but depths below 0.2 are culled and float32 is used.
EXTENT = (0.1, 100.0)
FEWEST_VIEWS = 20
FEWEST_POINTS = 1000
REGISTERED = 0.9  # share of the photos
FAR_POINT = 100.0  # extents from the cameras; a sky is some tens away
FAR_SHARE = 0.01
OPENING = (10.0, 150.0)  # degrees; outside, the focal length is doubtful
FEWEST_IN_VIEW = 10  # points of the cloud in a photo
_SAMPLE = 5000  # most points tested against the views
_WIDE = 1600
_COMPARED, _SMALL = 16, 200  # photos whose colours are compared, and their size in pixels
_GREY = 0.02  # spread of colours, below which they tell nothing
_ADJUSTED = 0.5  # median error of points with better poses, as a part of that with the given ones,
_SEEN = 0.2  # if that is more pixels
_WRONG = 5.0  # pixels, beyond which poses are wrong even if no better ones are near
_OTHER = 0.9  # error of another photo's colours, as a part of the own one's


def check_dataset(source: str, images: str) -> list[Line]:
    """Lines about the dataset in a folder. images: as train.py's -i."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            info = read_scene(source, images, hold_out=False, native=True)
    except UserError as error:
        return [*_warnings(said.getvalue()), from_error(error)]
    views = info.train_cameras
    checks = check_views(views), check_extent(info), check_lenses(views), check_cloud(info), check_poses(source, info)
    checks += (check_colors(info),)
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


def check_extent(info: SceneInfo) -> Iterator[Line]:
    """Scale of the scene, and cameras far away from the others."""
    centers = camera_centers(info.train_cameras)
    low, high = EXTENT
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    if len(centers) > 1 and spread < 1e-3 * info.extent:
        text = "all cameras stand in one place, so depth cannot be found"
        yield Line(text, "take photos from places some steps apart")
    if low <= info.extent <= high:
        yield Line(f"extent {info.extent:.3g}")
    else:
        remedy = f"scale cameras and points by {10.0 ** round(np.log10(5 / info.extent)):g}"
        text = f"the extent is {info.extent:.3g}, outside {low:g} to {high:g}"
        yield Line(text, f"{remedy}; depths below 0.2 are never drawn")
    far = [c.image_name for c, apart in zip(info.train_cameras, standing_apart(centers), strict=True) if apart]
    if far:
        text = f"{len(far)} cameras are more than {APART:g} times as far out as usual ({some(far)})"
        yield Line(text, "remove them from the model, as their poses are likely wrong; the extent leaves them out")


def check_lenses(cameras: list[CameraInfo]) -> Iterator[Line]:
    """Opening angles that no usual lens has."""
    low, high = np.radians(OPENING)
    odd = [camera for camera in cameras if not low <= camera.FovX <= high]
    if odd:
        example = f"{odd[0].image_name}: {np.degrees(odd[0].FovX):.1f} degrees"
        remedy = "check the focal length and the size of the photos, or reconstruct the scene again"
        yield Line(f"{len(odd)} cameras have odd opening angles ({example})", remedy)


def check_cloud(info: SceneInfo) -> Iterator[Line]:
    """Number of points, points far away, and points that no camera sees."""
    points = info.point_cloud.points.astype(np.float64)
    text = f"{len(points)} points to start from"
    if len(points) < FEWEST_POINTS:
        more = "start from more points (--init_pcd_path), or reconstruct with more photos or features"
        yield Line(f"only {text}; {FEWEST_POINTS} or more are good", more)
    else:
        yield Line(text)
    if not len(points):
        return
    far = np.linalg.norm(points - camera_centers(info.train_cameras).mean(axis=0), axis=1) > FAR_POINT * info.extent
    if far.mean() > FAR_SHARE:
        text = f"{far.mean():.1%} of the points are more than {FAR_POINT:g} extents away"
        yield Line(text, "remove them from the cloud (COLMAP: filter by reprojection error and angle)")
    sample = points[:: max(1, len(points) // _SAMPLE)]
    seen = np.array([projected(camera, sample)[2] for camera in info.train_cameras])
    unseen = float((~seen.any(axis=0)).mean())
    counts = seen.sum(axis=1) * len(points) / seen.shape[1]
    away = [c.image_name for c, n in zip(info.train_cameras, counts, strict=True) if n < FEWEST_IN_VIEW]
    if unseen > 0.5:
        remedy = "poses and points do not belong together: check the axes (x right, y down, z forward) and the scale"
        yield Line(f"{unseen:.0%} of the points are in no photo", remedy)
    elif away:
        text = f"{len(away)} cameras have hardly any point in view ({some(away)})"
        yield Line(text, "remove them from the model: they face away from the scene, or their poses are wrong")


def check_colors(info: SceneInfo) -> Iterator[Line]:
    """Colours of the points beside those of the photos where they are seen: photos may have each other's names."""
    step = max(1, len(info.point_cloud.points) // _SAMPLE)
    cloud = BasicPointCloud(*(values[::step] for values in info.point_cloud))
    if len(cloud.points) < FEWEST_IN_VIEW or cloud.colors.std(axis=0).max() < _GREY:
        return
    cameras = info.train_cameras[:: max(1, len(info.train_cameras) // _COMPARED)][:_COMPARED]
    photos = [_pixels(camera) for camera in cameras]
    names = [one.image_name for place, one in enumerate(cameras) if _is_another(one, place, photos, cloud)]
    if len(cameras) >= 3 and len(names) > len(cameras) / 2:
        text = f"the points have the colours of other photos than those they are seen in ({some(names)})"
        yield Line(text, "the photos have each other's names: restore those that the cameras were reconstructed with")


def check_poses(source: str, info: SceneInfo) -> Iterator[Line]:
    """Tracks that other poses fit far better than the given ones, as after a bundle adjustment they cannot."""
    views = info.train_cameras
    try:
        found = pose_errors(views, read_tracks(source, views, info.offset), info.extent)
    except UserError as error:
        yield from_error(error)
        return
    if found is None:
        return
    given, best = found
    text = f"points lie {given:.2g} pixels from where photos show them (median)"
    if poses_differ(given, best):
        better = "train with --refine_poses, or adjust the model again (COLMAP: bundle_adjuster)"
        yield Line(f"{text}, and {best:.2g} with better poses", better)
    elif given > _WRONG:
        yield Line(text, "adjust the model again (COLMAP: bundle_adjuster); --refine_poses corrects 3 degrees at most")


def pose_errors(
    views: Sequence[CameraInfo], tracks: Sequence[Track | None], extent: float
) -> tuple[float, float] | None:
    """Pixels from points to where photos show them (median), with their poses and with the best ones; None: no tracks.

    Of _COMPARED views.
    """
    errors, step = [], max(1, len(views) // _COMPARED)
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


def _pixels(camera: CameraInfo) -> np.ndarray:
    """A photo, small, (H, W, 3) in [0, 1]."""
    with Image.open(camera.image_path) as image:
        image.draft("RGB", (_SMALL, _SMALL))
        image = image.convert("RGB")
        image.thumbnail((_SMALL, _SMALL))
        return np.asarray(image) / 255


def _is_another(camera: CameraInfo, place: int, photos: list[np.ndarray], cloud: BasicPointCloud) -> bool:
    """Whether another photo has clearly more of the colours of the points that a camera sees than its own, `place`."""
    x, y, inside = projected(camera, cloud.points)
    errors = []
    for photo in photos:
        rows = (y[inside] / camera.height * photo.shape[0]).astype(int)
        columns = (x[inside] / camera.width * photo.shape[1]).astype(int)
        errors.append(np.abs(photo[rows, columns] - cloud.colors[inside]).mean() if inside.any() else 0.0)
    return min(errors) < _OTHER * errors[place]


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
