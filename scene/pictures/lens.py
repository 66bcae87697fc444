"""Camera models by COLMAP's names: which are pinholes already, and which pinhole picture the others become.

COLMAP chooses the pinhole: no pixel of it lies outside the photo. Where rays of the photo's border cannot be projected
by a pinhole (a fisheye that sees half the world and more) it has nothing to go by, and `WIDEST` decides instead.
"""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from scene.pictures.pycolmap_import import import_pycolmap
from utils.system_utils import UserError

WIDEST = 60.0  # degrees to either side; a pinhole stretches what is farther out more than fourfold
_PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}  # parameters each
_ROUND_TRIP = 0.5  # pixels by which a border point may miss itself, there and back, before its ray counts as useless


class Lens(NamedTuple):
    """COLMAP's camera model by name, its parameters in COLMAP's order, for pictures of width x height pixels."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int


class Pinhole(NamedTuple):
    """Focal lengths and principal point in pixels of a picture of width x height, pixel centres at .5."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class Undistortion(NamedTuple):
    """How pictures of a lens become pinhole pictures.

    camera, options: pycolmap's, for undistort_image. pinhole: of the result. widest: half the angle in degrees to which
    a wide lens is cut, else None.
    """

    camera: Any
    options: Any
    pinhole: Pinhole
    widest: float | None


def pinhole_of(lens: Lens, name: str) -> Pinhole | None:
    """The lens as a pinhole, or None where pictures must be undistorted first.

    name: of a picture, for the UserError that a lens which is unusable, or sees all around, ends in.
    """
    if not (np.isfinite(lens.params).all() and min(lens.width, lens.height) > 0):
        raise _unusable(lens, name)
    if len(lens.params) == _PINHOLES.get(lens.model):  # without pycolmap, which is slow to import
        focal, center = lens.params[:-2], lens.params[-2:]
    else:
        camera = _camera(lens, name)
        if not camera.is_perspective():
            raise UserError(
                f"the picture {name} has the camera model {lens.model}, a panorama that no pinhole can show; cut it "
                "into perspective pictures and reconstruct those"
            )
        focal = tuple(lens.params[index] for index in camera.focal_length_idxs())
        center = tuple(lens.params[index] for index in camera.principal_point_idxs())
        # is_undistorted alone also holds for a fisheye without further parameters.
        straight = camera.is_perspective_pinhole() and camera.is_undistorted()
        if not straight and min(focal) > 0:
            return None
    if min(focal) <= 0:
        raise _unusable(lens, name)
    return Pinhole(focal[0], focal[-1], *center, lens.width, lens.height)


def _unusable(lens: Lens, name: str) -> UserError:
    return UserError(
        f"the camera of {name} has no usable size or focal length ({lens.model}, {lens.width} x {lens.height}, "
        f"{lens.params}); mend it, or export the cameras again"
    )


def _camera(lens: Lens, name: str = "") -> Any:
    pycolmap = import_pycolmap()
    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    if not camera.verify_params():
        raise _unusable(lens, name)
    return camera


@functools.cache
def undistortion(lens: Lens, width: int, height: int) -> Undistortion:
    """How to undistort pictures of a lens that are width x height pixels large (the lens is scaled to that)."""
    pycolmap = import_pycolmap()
    camera = _camera(lens)
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


@functools.lru_cache(maxsize=4)  # few, for they are large, and pictures of one lens mostly follow each other
def shown_pixels(lens: Lens, width: int, height: int) -> np.ndarray:
    """Which pixels of the undistorted picture the photo, width x height pixels large, shows: (height, width) bool."""
    pycolmap = import_pycolmap()
    plan = undistortion(lens, width, height)
    white = pycolmap.Bitmap.from_array(np.full((height, width), 255, np.uint8))
    shown, result = pycolmap.undistort_image(plan.options, white, plan.camera)
    shown = shown.to_array() == 255
    return shown if plan.widest is None else shown & _seen_once(plan.camera, result)


def _border_can_be_projected(camera: Any) -> bool:
    along = np.linspace(0, 1, 65)
    sides = [np.column_stack([along, np.full(65, end)]) for end in (0, 1)]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * (camera.width, camera.height)
    return bool(_round_trip(camera, border).max() < _ROUND_TRIP)


def _round_trip(camera: Any, pixels: np.ndarray) -> np.ndarray:
    """Distance (N,) in pixels of points (N,2) from where they come back to through their rays; infinite without one."""
    with np.errstate(all="ignore"):
        rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
        distance = np.linalg.norm(camera.img_from_cam(rays) - pixels, axis=1)
    return np.nan_to_num(distance, nan=np.inf)


def _seen_once(camera: Any, pinhole: Any) -> np.ndarray:
    """(height, width) bool: pixels of the pinhole whose ray the photo really shows.

    Far out a distortion polynomial turns back, and the photo would be shown there again.
    """
    x, y = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = pinhole.cam_from_img(np.column_stack([x.ravel(), y.ravel()]))
    with np.errstate(all="ignore"):
        back = camera.cam_from_img(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
        missed = np.linalg.norm(back - rays, axis=1) * pinhole.mean_focal_length()
    return (missed < _ROUND_TRIP).reshape(y.shape)
