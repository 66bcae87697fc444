"""Checks of cameras: sides of photos, opening angles, principal points, shared lenses, places, scale, rounding."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from groundwork.finding import Finding, Severity, fine
from groundwork.host.listing import counted, some
from scene.images.exif import read_lens
from scene.readers.info import (
    APART,
    NARROW,
    NEAREST,
    CameraInfo,
    SceneInfo,
    are_exchanged,
    camera_centers,
    describe_exchanged_sides,
    outliers,
    photo_size,
)
from scene.readers.scene_folder import find_capture
from scene.readers.start_cloud import nearest_to_axes
from scene.readers.tracks import enlargement

OTHER_FORMS = (
    "check the scale, and whether poses are as the file needs them: COLMAP's from world to camera, y down and z "
    "forward, with a translation that is no place; those of transforms.json from camera to world, y up and z backward"
)
# Learning rates and size limits are fractions of the extent, but depths below 0.2 are culled and float32 is used.
EXTENT = (1e-3, 1e4)  # photos of 4.8 score the same within seeds at 0.0048 and 4,800
OPENING = (10.0, 150.0)  # degrees, of a pinhole; outside, the focal length is doubtful
_FISHEYE = (10.0, 359.0)  # degrees, of a fisheye: its focal length times the angle is the photo's size
_EDGE = 0.02  # of a side: a principal point so near to an edge
_CORNER = 0.3  # of both sides, from the middle
_ASPECT = 2.0  # most of one focal length over the other; anamorphic lenses have up to 1.8
_STEP = 1e-3  # of the extent: half a pixel or more in photos that are not small
_OFF = 0.02  # steps from a rounded number, which arithmetic leaves
_NEARLY_ALL = 0.99
_SAMPLE = 5000  # points
_FEWEST = 4  # cameras whose places tell of the form of their poses
_ONE_PLACE = 1e-6  # of the distance from the origin, which even map coordinates do not reach
_MEETING = 0.05  # of the distance to where axes meet, by which they may miss it
_LONGER = 0.03  # difference of focal lengths that counts


def check_cameras(info: SceneInfo) -> Iterator[Finding]:
    """Check forms of poses, lenses, sides and places of the cameras."""
    yield from check_pose_forms(info)
    yield from check_lens_shapes(info)
    yield from _check_sides([*info.train_cameras, *info.test_cameras])
    yield from _check_places(info)


def check_pose_forms(info: SceneInfo) -> Iterator[Finding]:
    """Find poses that look like another form's, such as inverted matrices; only where no points can tell."""
    centers = camera_centers(info.train_cameras)
    if len(centers) < _FEWEST or not (info.has_random_points or info.point_cloud is None):
        return
    if np.ptp(centers, axis=0).max() < _ONE_PLACE * np.abs(centers + info.offset).max():
        yield Finding("all cameras stand in one place, so depth cannot be found", OTHER_FORMS)
        return
    axes = np.array([camera.R[:, 2] for camera in info.train_cameras])
    if behind := nearest_to_axes(centers, -axes):
        missed = np.linalg.norm(np.cross(behind[0] - centers, axes), axis=1)
        if np.median(missed) < _MEETING * behind[1]:
            yield Finding("the cameras stand around a place and look away from it", OTHER_FORMS)


def check_lens_shapes(info: SceneInfo) -> Iterator[Finding]:
    """Check rounding, opening angles and principal points: causes by which points may not fit the photos."""
    views = [*info.train_cameras, *info.test_cameras]
    yield from _check_rounding(info, views)
    pinholes = [view for view in views if _find_chart(view) != "equirectangular"]
    yield from _check_angles(pinholes)
    yield from _check_principal_points(pinholes)


def _find_chart(view: CameraInfo) -> str:
    native = getattr(view, "native", None)
    return native.chart if native else "perspective"


def _check_rounding(info: SceneInfo, views: Sequence[CameraInfo]) -> Iterator[Finding]:
    """Find large coordinates, as of maps, that were written with too few digits for the scene's extent."""
    if not (info.offset.any() and info.extent) or any(check_pose_forms(info)):
        return
    centers = camera_centers(views) + info.offset
    moves = np.array([view.T - view.R.T @ info.offset for view in views])  # as COLMAP's files have them
    points = np.zeros((0, 3)) if info.point_cloud is None else np.asarray(info.point_cloud.points, np.float64)
    least = _STEP * info.extent
    steps = {
        "cameras": _find_step(centers, least) or _find_step(moves, least),
        "points": _find_step(points[:: 1 + len(points) // _SAMPLE] + info.offset, least),
    }
    if told := [f"the {what} to steps of {step:.2g}" for what, step in steps.items() if step]:
        text = f"coordinates are rounded: {', '.join(told)}, in a scene with an extent of {info.extent:.3g}"
        remedy = "export them with more digits, or subtract the coordinates of a place in the scene before"
        yield Finding(text, remedy)


def _find_step(values: np.ndarray, least: float) -> float | None:
    """The step, at least `least`, to which the largest values are rounded: by decimal digits, or as float32."""
    size = np.abs(values)
    if not np.isfinite(size).all() or not size.any():
        return None
    spread = np.ptp(values, axis=0).max()
    values, size = values[large := size > 0.01 * size.max()], size[large]  # others may have finer steps
    places = np.floor(np.log10(size)) + 1  # before the point
    finest = int(np.floor(places.max() - np.log10(least)))
    rounded = [(10.0 ** (places - digits), 10.0 ** (places.max() - digits)) for digits in range(1, finest + 1)]
    single = np.spacing(size.astype(np.float32)).astype(np.float64)
    for steps, largest in [*rounded, *([(single, float(single.max()))] if single.max() >= least else [])]:
        near = np.abs(values / steps - np.round(values / steps)) < _OFF
        if near.mean() > _NEARLY_ALL and largest <= spread:  # else all lie far away, as map coordinates do
            return float(largest)
    return None


def _check_sides(views: Sequence[CameraInfo]) -> Iterator[Finding]:
    """Find photos whose width is their camera's height; our own readers refuse them."""
    wrong = [(view, size) for view in views if are_exchanged(size := photo_size(view), (view.width, view.height))]
    if wrong:
        (view, size), names = wrong[0], [view.image_name for view, _ in wrong]
        text, remedy = describe_exchanged_sides(names, len(views), size, (view.width, view.height))
        yield Finding(text, remedy, Severity.HOPELESS)


def opening(view: CameraInfo) -> tuple[float, float]:
    """Horizontal and vertical opening angles of a view, degrees."""
    if _find_chart(view) == "equidistant":
        return tuple(np.degrees([view.width / view.fx, view.height / view.fy]).tolist())
    return tuple(np.degrees([view.FovX, view.FovY]).tolist())


def _check_angles(views: Sequence[CameraInfo]) -> Iterator[Finding]:
    """Find unusual opening angles, and pixels that are far from square."""
    odd: Counter[str] = Counter()
    examples: dict[str, tuple[CameraInfo, float]] = {}
    for view in views:
        low, high = _FISHEYE if _find_chart(view) == "equidistant" else OPENING
        angle = max(opening(view))
        if low <= angle <= high:
            continue
        # Focal lengths as parts of the size are about 1, and those in millimetres some tens.
        unit = "parts of the size" if view.fx < 5 else "millimetres" if view.fx < 0.1 * view.width else "another unit"
        odd[unit] += 1
        examples.setdefault(unit, (view, angle))
    for unit, count in odd.items():
        view, angle = examples[unit]
        example = f"{view.image_name}: {angle:.1f} degrees, a focal length of {view.fx:.4g} pixels"
        remedy = f"give focal lengths in pixels (these may be in {unit}), or check the size of the photos"
        yield Finding(f"odd opening angles of {counted(count, 'camera')} ({example})", remedy)
    flat = [v for v in views if not 1 / _ASPECT <= v.fx / v.fy <= _ASPECT]
    if flat:
        example = f"{flat[0].image_name}: {flat[0].fx:.4g} and {flat[0].fy:.4g} pixels"
        text = f"focal lengths in x and y of {counted(len(flat), 'camera')} differ more than twofold ({example})"
        yield Finding(text, "check the focal lengths and the size of the photos")


def _check_principal_points(views: Sequence[CameraInfo]) -> Iterator[Finding]:
    """Find principal points at an edge or near a corner of the photo; a crop of a larger photo may have any."""
    odd = []
    for view in views:
        across, down = view.cx / view.width, view.cy / view.height
        edge = any(min(abs(part), abs(part - 1)) < _EDGE for part in (across, down))
        if edge or min(abs(across - 0.5), abs(down - 0.5)) > _CORNER:
            odd.append(view)
    if odd:
        view = odd[0]
        at = f"{view.image_name}: {view.cx:.4g}, {view.cy:.4g} of {view.width} x {view.height}"
        text = f"the principal point of {counted(len(odd), 'camera')} is in a corner or at an edge of the photo ({at})"
        yield Finding(text, "give cx and cy in pixels of a photo of that size, or leave them out")


def _check_places(info: SceneInfo) -> Iterator[Finding]:
    """Find cameras in one place, or far away from the others."""
    cameras = info.train_cameras
    centers = camera_centers(cameras)
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    # Where they do, the extent is not theirs but the distance of the points (`scene_extent`).
    if len(centers) > 1 and info.extent and spread < NARROW * info.extent and not any(check_pose_forms(info)):
        text = f"all cameras stand in one place, {spread:.2g} units apart and {info.extent:.2g} from the points"
        text += ", so depth cannot be found"
        yield Finding(text, "take photos from places some steps apart, or give cameras and points in one unit")
    apart = outliers(centers)
    if apart.any():
        names = [camera.image_name for camera, far in zip(cameras, apart, strict=True) if far]
        text = (
            f"{len(names)} of {len(apart)} cameras are more than {APART:g} times as far from the middle as the median "
            f"camera ({some(names)})"
        )
        yield Finding(text, f"check their poses; the scene's extent, {info.extent or 0:.3g}, leaves them out")


def check_lenses(source: str, views: Sequence[CameraInfo]) -> Iterator[Finding]:
    """Find photos that share a camera although their EXIF data have different focal lengths."""
    shared: dict[tuple, Counter[float]] = {}
    shots = find_capture(Path(source)).place
    for view in views:
        # Programs that undistort photos keep few EXIF data: convert.py has the photos themselves.
        lens = read_lens(view.image_path)
        lens = lens if lens.length else read_lens(shots / view.image_name)
        key = view.width, view.height, view.fx, view.fy, view.cx, view.cy
        shared.setdefault(key, Counter())[lens.length] += 1
    for lengths in shared.values():
        found = sorted(length for length in lengths if length)
        if found and found[-1] > (1 + _LONGER) * found[0]:
            listed = some([f"{length:g} mm ({lengths[length]})" for length in found])
            yield Finding(
                f"{lengths.total()} photos share one camera, but their EXIF data tell several focal lengths: {listed}",
                "convert them again with convert.py --cameras per_lens, or let the program that made the cameras "
                "give each lens its own",
            )


def check_extent(info: SceneInfo) -> Iterator[Finding]:
    """Check the scale of the scene."""
    if any(check_pose_forms(info)):
        return
    low, high = EXTENT
    if low <= info.extent <= high:
        factor = enlargement(info)
        near = f", so depths from {NEAREST / factor:.2g} on are drawn" if factor != 1 else ""
        yield fine(f"extent {info.extent:.3g}{near}")
    else:
        remedy = f"scale cameras and points by {10.0 ** round(np.log10(5 / info.extent)):g}"
        yield Finding(f"the extent is {info.extent:.3g}, outside {low:g} to {high:g}", remedy)
