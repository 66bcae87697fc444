"""Lenses, by COLMAP's camera models, and the pinhole cameras that replace them.

COLMAP chooses the pinhole so that none of its pixels lies outside the photo. A fisheye that sees half the world or more
has border rays that no pinhole can project; then `WIDEST` decides.
"""

import functools
import importlib.util
import math
import signal
import sys
import threading
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from diff_gaussian_rasterization.lens import MODELS
from diff_gaussian_rasterization.lens import lens_of as native_of

# Pillow's zlib must be in the process before pycolmap's, or writing a PNG aborts (pycolmap 4.2.1, Pillow 13.0).
from PIL import Image  # noqa: F401

from utils.system_utils import UserError

PANORAMA = "EQUIRECTANGULAR"
PERSPECTIVE = *(model for model, (chart, *_) in MODELS.items() if chart == "perspective"), "SIMPLE_DIVISION", "DIVISION"
WIDEST = 60.0  # degrees to either side; farther out, a pinhole stretches the photo more than fourfold
_STRAIGHT = 1e-8  # COLMAP takes smaller parameters for no distortion
# In sizes of the photo. Beyond these bounds lie damaged files and other units, not lenses: fields of view below a
# thousandth of a degree, or so near 180 degrees that no pinhole shows anything.
_SHORTEST, _LONGEST = 1e-4, 1e5  # focal length
_FARTHEST = 100.0  # principal point, from the middle; parts cut out of a large photo have it outside
_LARGEST = 1 << 20  # pixels a side
_STRETCH = 10.0  # times that a distortion may change an angle; lenses in use change it less than threefold
_WIDE = 1.4  # radians from a fisheye's axis, beyond which the edge of its picture lies
_ROUND_TRIP = 0.5  # pixels: largest error of a usable ray, from a pixel to the ray and back


class Lens(NamedTuple):
    """COLMAP's camera model by name, its parameters in COLMAP's order, for photos of width x height pixels."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int


class Pinhole(NamedTuple):
    """Focal lengths and principal point in pixels of an image of width x height, pixel centres at .5."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class Undistortion(NamedTuple):
    """Parameters for turning photos of a lens into pinhole images.

    camera, options: pycolmap's, for undistort_image. pinhole: of the result. widest: half the angle in degrees to which
    the field of view of a wide lens is cut, else None.
    """

    camera: Any
    options: Any
    pinhole: Pinhole
    widest: float | None


def pinhole_of(lens: Lens, name: str) -> Pinhole | None:
    """The lens as a pinhole, or None if it distorts.

    name: of a photo, for the message. UserError for a lens that is unusable.
    """
    narrow, wide = sorted((lens.width, lens.height))
    if not (np.isfinite(lens.params).all() and narrow > 0 and wide <= _LARGEST):
        raise _make_lens_error(lens, name)
    if lens.model == PANORAMA:
        if lens.params != (lens.width, lens.height):
            raise _make_lens_error(lens, name)
        return None
    if lens.model in MODELS:  # without pycolmap, which is slow to import
        chart, focals, places = MODELS[lens.model]
        if len(lens.params) != focals + 2 + len(places):
            raise _make_lens_error(lens, name)
        focal, center, further = lens.params[:focals], lens.params[focals : focals + 2], lens.params[focals + 2 :]
        straight = chart == "perspective" and max(map(abs, further), default=0.0) < _STRAIGHT
    else:
        camera = _make_camera(lens, name)
        focal = tuple(lens.params[index] for index in camera.focal_length_idxs())
        center = tuple(lens.params[index] for index in camera.principal_point_idxs())
        # is_undistorted alone is also true of a fisheye without further parameters.
        straight = camera.is_perspective_pinhole() and camera.is_undistorted()
    _check_bounds(lens, focal, center, name)
    if not straight and not _is_plausible(lens, min(focal)):
        raise UserError(
            f"the distortion of the camera of {name} folds its photo or changes angles more than {_STRETCH:g} times "
            f"({lens.model}, {lens.params}); calibrate the camera again, or export the cameras again"
        )
    return Pinhole(focal[0], focal[-1], *center, lens.width, lens.height) if straight else None


def rays_of(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """x / z and y / z (N, 2) of the rays of pixels (N, 2), pixel centres at .5; NaN where a ray has none.

    A panorama, most of whose rays have none, gives NaN throughout. COLMAP's fisheyes name rays of other pixels for
    those that lie beyond 90 degrees.
    """
    if lens.model == PANORAMA:
        return np.full(pixels.shape, np.nan)
    if lens.model in ("SIMPLE_PINHOLE", "PINHOLE"):  # without pycolmap
        focal, center = np.array(lens.params[:-2]), np.array(lens.params[-2:])
        return (pixels - center) / focal
    camera, pixels = _make_camera(lens), np.ascontiguousarray(pixels)
    rays = np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
    return np.where(_measure_round_trip(camera, pixels)[:, None] < _ROUND_TRIP, rays, np.nan)


def _check_bounds(lens: Lens, focal: Sequence[float], center: Sequence[float], name: str) -> None:
    size = max(lens.width, lens.height)
    astray = max(abs(center[0] / lens.width - 0.5), abs(center[1] / lens.height - 0.5))
    if not (_SHORTEST * size <= min(focal) <= max(focal) <= _LONGEST * size and astray <= _FARTHEST):
        raise _make_lens_error(lens, name)


@functools.lru_cache(maxsize=4096)
@np.errstate(all="ignore")
def _is_plausible(lens: Lens, focal: float) -> bool:
    """Tell whether a lens shows each direction once, and nearly where it would without distortion.

    Directions of the circle that touches the photo's nearer sides are asked for; beyond it, many calibrated polynomials
    turn back. So do those of fisheyes behind the edge of a smaller picture.
    """
    inner = min(lens.width, lens.height) / 2
    if lens.model not in MODELS:
        around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        circle = inner / 2 * np.column_stack([np.cos(around), np.sin(around)])  # wider, a fisheye has rays behind it
        camera = _make_camera(lens)
        return bool(
            _measure_round_trip(camera, circle + (camera.principal_point_x, camera.principal_point_y)).max()
            < _ROUND_TRIP
        )
    native = native_of(lens.model, lens.params)
    fisheye = native.chart == "equidistant"
    r = np.linspace(0, min(_STRETCH * inner / focal, math.pi if fisheye else math.inf), 4097)
    over, under = (np.polyval([*terms[::-1], 1.0], r * r) for terms in (native.radial, native.divisor))
    aside = math.hypot(*(3 * p + s for p, s in zip(native.tangential[::-1], native.prism, strict=True)))
    radius = r * over / under
    rises = np.diff(radius) > 2 * aside * r[1:] * r[1]  # where tangential and prism terms take most of the slope
    end = len(rises) if rises.all() else int(rises.argmin())
    reached = radius[: end + 1] * focal >= inner
    if not reached.any():
        return fisheye and r[end] >= _WIDE
    return bool(r[reached.argmax()] * focal * _STRETCH > inner)


def _make_lens_error(lens: Lens, name: str) -> UserError:
    return UserError(
        f"the camera of {name} has no usable size or focal length, or a principal point far outside of the photo "
        f"({lens.model}, {lens.width} x {lens.height}, {lens.params}); fix it, or export the cameras again"
    )


def _make_camera(lens: Lens, name: str = "") -> Any:
    """Make the pycolmap camera of a lens. UserError for parameters that do not fit; name: of the photo, for it."""
    pycolmap = import_pycolmap()
    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    if not camera.verify_params():
        raise _make_lens_error(lens, name)
    return camera


@functools.cache
def undistortion(lens: Lens, width: int, height: int) -> Undistortion:
    """Undistortion for photos of a lens that are width x height pixels large; the lens is scaled to that size."""
    pycolmap = import_pycolmap()
    camera = _make_camera(lens)
    if (lens.width, lens.height) != (width, height):
        camera.rescale(width, height)
    options = pycolmap.UndistortCameraOptions()
    widest = None
    if not _border_can_be_projected(camera):
        scale = 2 * math.tan(math.radians(WIDEST)) * camera.mean_focal_length() / max(width, height)
        options.min_scale = options.max_scale = min(max(scale, options.min_scale), options.max_scale)
        widest = math.degrees(math.atan(options.max_scale * max(width, height) / 2 / camera.mean_focal_length()))
    result = pycolmap.undistort_camera(options, camera)
    pinhole = Pinhole(*(float(value) for value in result.params), int(result.width), int(result.height))
    return Undistortion(camera, options, pinhole, widest)


@functools.lru_cache(maxsize=4)  # few: they are large, and photos of one lens mostly follow each other
def visible_pixels(lens: Lens, width: int, height: int) -> np.ndarray:
    """Pixels of the undistorted image that the photo, width x height pixels large, shows: (height, width) bool."""
    pycolmap = import_pycolmap()
    plan = undistortion(lens, width, height)
    white = pycolmap.Bitmap.from_array(np.full((height, width), 255, np.uint8))
    visible, result = pycolmap.undistort_image(plan.options, white, plan.camera)
    visible = visible.to_array() == 255
    return visible if plan.widest is None else visible & _find_visible(plan.camera, result)


def _border_can_be_projected(camera: Any) -> bool:
    along = np.linspace(0, 1, 65)
    sides = [np.column_stack([along, np.full(65, end)]) for end in (0, 1)]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * (camera.width, camera.height)
    return bool(_measure_round_trip(camera, border).max() < _ROUND_TRIP)


def _measure_round_trip(camera: Any, pixels: np.ndarray) -> np.ndarray:
    """Error (N,) in pixels of points (N,2) after projection to their rays and back; infinite without a ray."""
    with np.errstate(all="ignore"):
        rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
        distance = np.linalg.norm(camera.img_from_cam(rays) - pixels, axis=1)
    return np.nan_to_num(distance, nan=np.inf)


def _find_visible(camera: Any, pinhole: Any) -> np.ndarray:
    """Pixels of the pinhole whose rays the photo really shows: (height, width) bool.

    Far from the centre a distortion polynomial turns back, and would show parts of the photo a second time.
    """
    x, y = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = pinhole.cam_from_img(np.column_stack([x.ravel(), y.ravel()]))
    with np.errstate(all="ignore"):
        back = camera.cam_from_img(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
        missed = np.linalg.norm(back - rays, axis=1) * pinhole.mean_focal_length()
    return (missed < _ROUND_TRIP).reshape(y.shape)


def import_pycolmap() -> ModuleType:
    """The module `pycolmap`, whose import takes time and loads libraries that a Blender scene does not need.

    UserError where it is not installed: it has no wheel for Linux on 64-bit Arm.
    """
    if "pycolmap" not in sys.modules and importlib.util.find_spec("pycolmap") is None:
        raise UserError(
            "pycolmap is not installed, which convert.py and --lenses undistort need (pip install pycolmap); "
            "where it has no wheel, as on Linux for Arm, convert and undistort the photos on another machine"
        )
    import pycolmap

    # The import makes glog answer SIGTERM with a stack dump. Python still reports its own handler, and setting that
    # again restores it.
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
