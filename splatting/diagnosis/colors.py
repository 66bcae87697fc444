"""Colours of the points beside those of the photos: a geometric cause is tried first, then exchanged photos."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scene.dataset_readers import CameraInfo, SceneInfo
from scene.readers.tracks import projected
from splatting.diagnosis import Line
from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import open_image
from splatting.files.listing import some
from utils.graphics_utils import BasicPointCloud

_SAMPLE = 5000  # most points
_FEWEST = 10  # points in a photo, and in all
_GREY = 0.02  # spread of colours, below which they tell nothing
_CAMERAS = 16  # that geometric causes are tried on
_PHOTOS, _SMALL = 400, 200  # most photos that are compared, and their size in pixels
_SUSPECTS = 24  # photos that fit their cameras worst
_CLEARLY = 0.8  # error with another cause or photo, as a part of the given one's
_MOST = 0.75  # share of the cameras that a geometric cause makes better
_FOCAL = (0.5, 0.6, 0.75, 0.87, 1.15, 1.33, 1.7, 2.0)
UNITS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)


class _Photos(NamedTuple):
    """Cameras and their photos, (H, W, 3) in [0, 1], and the points that they see."""

    cameras: Sequence[CameraInfo]
    pixels: Sequence[np.ndarray]
    cloud: BasicPointCloud


def check_colors(info: SceneInfo) -> Iterator[Line]:
    """The likeliest cause, if photos have other colours than the points that they should show."""
    step = max(1, len(info.point_cloud.points) // _SAMPLE)
    cloud = BasicPointCloud(*(values[::step] for values in info.point_cloud))
    if len(cloud.points) < _FEWEST or cloud.colors.std(axis=0).max() < _GREY:
        return
    step = -(-len(info.train_cameras) // _PHOTOS)
    cameras = info.train_cameras[::step]
    photos = _Photos(cameras, [_pixels(camera) for camera in cameras], cloud)
    if wrong := [*_geometric(photos)]:
        yield wrong[0]
    else:
        yield from _exchanged(photos)


def _pixels(camera: CameraInfo) -> np.ndarray:
    """A photo, small, (H, W, 3) in [0, 1]."""
    with open_image(camera.image_path) as image:
        image.draft("RGB", (_SMALL, _SMALL))
        image = in_srgb(image).convert("RGB")
        image.thumbnail((_SMALL, _SMALL))
        return np.asarray(image) / 255


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


def _geometric(photos: _Photos) -> Iterator[Line]:
    """Another focal length, or another unit of the points, with which most photos fit clearly better."""
    step = -(-len(photos.cameras) // _CAMERAS)
    some_of = _Photos(photos.cameras[::step], photos.pixels[::step], photos.cloud)
    focal = {k: some_of._replace(cameras=[_refocused(c, k) for c in some_of.cameras]) for k in _FOCAL}
    units = {k: some_of._replace(cloud=some_of.cloud._replace(points=k * some_of.cloud.points)) for k in UNITS}
    given = _own(some_of)
    found = [(name, k, _own(other)) for name, tried in (("f", focal), ("u", units)) for k, other in tried.items()]
    name, factor, errors = min(found, key=lambda one: np.median(one[2]))
    if not (errors < _CLEARLY * given).mean() >= _MOST:
        return
    if name == "f":
        text = f"photos fit the points with focal lengths about {factor:g} times as long"
        yield Line(text, "check the focal lengths and the size of the photos that they belong to")
    else:
        text = f"photos fit the points if those are scaled by {factor:g}: cameras and points have different units"
        yield Line(text, f"scale the points by {factor:g}")


def _refocused(camera: CameraInfo, factor: float) -> CameraInfo:
    if camera.native:
        return camera  # its distortion would have to change, too
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def _own(photos: _Photos) -> np.ndarray:
    pairs = zip(photos.cameras, photos.pixels, strict=True)
    return np.array([_errors(camera, [pixels], photos.cloud)[0] for camera, pixels in pairs])


def _exchanged(photos: _Photos) -> Iterator[Line]:
    """Photos that show clearly more of what another camera should see than its photo does, and than of their own."""
    own = _own(photos)
    suspects = np.argsort(np.where(np.isfinite(own), -own, 0))[:_SUSPECTS]
    shapes = np.array([camera.width / camera.height for camera in photos.cameras])
    pairs: set[tuple[int, int]] = set()  # a photo, and the camera that it fits
    for camera in suspects:
        errors = _errors(photos.cameras[camera], photos.pixels, photos.cloud)
        errors[~np.isclose(shapes, shapes[camera], rtol=0.02)] = np.inf
        best = int(errors.argmin())
        if errors[best] < _CLEARLY * min(own[camera], own[best]):
            pairs.add((best, camera))
            back = _errors(photos.cameras[best], [photos.pixels[camera]], photos.cloud)[0]
            pairs |= {(int(camera), best)} if back < own[best] else set()
    if pairs:
        shown = [[photos.cameras[n].image_name for n in pair] for pair in sorted(pairs)]
        names = [f"{photo} shows what {camera} should" for photo, camera in shown]
        text = f"photos have each other's names ({some(names)})"
        yield Line(text, "restore the names that the cameras were reconstructed with")
