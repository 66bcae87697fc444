"""Views of any lens as pinhole views: their records, what they are checked for, and their undistortion."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from diff_gaussian_rasterization.lens import MODELS, lens_of

from scene.images.decode import picture_size, picture_sizes
from scene.images.lens import PANORAMA, Lens, Pinhole, pinhole_of, undistortion
from scene.images.masks import Mask
from scene.readers.info import CameraInfo, turned
from scene.readers.turned import exchanged, turned_by_exif
from scene.readers.undistortion import undistort
from utils.system_utils import UserError

FARTHEST = 1e12  # from the origin, beyond which lie damaged files; there a double has steps of 1e-4


def camera_info(
    uid: int,
    name: str,
    path: Path,
    lens: Lens,
    R: np.ndarray,
    T: np.ndarray,
    mask: Mask | None = None,
    ignore_alpha: bool = False,
    native: bool = False,
) -> CameraInfo:
    """The view of a photo with any lens. The photo is only read if it has to be undistorted.

    native: take photos as they are, through their lenses, where the rasterizer knows the camera model.

    UserError names a view that cannot be used: its lens, its pose, or the photo.
    """
    pinhole, through = pinhole_of(lens, name), None
    distorts = pinhole is None
    if distorts and native and lens.model in MODELS:
        through, distorts = lens_of(lens.model, lens.params), False
        pinhole = Pinhole(*through.focal, *(place + 0.5 for place in through.center), lens.width, lens.height)
    elif distorts and lens.model == PANORAMA:
        raise UserError(
            f"the photo {name} is a panorama, which no pinhole image can show; train on it with --lenses native"
        )
    elif distorts:
        pinhole = undistortion(lens, *picture_size(path)).pinhole
    camera = CameraInfo(
        uid=uid,
        R=R,
        T=T,
        **pinhole._asdict(),
        image_path=path,
        image_name=name,
        lens=lens if distorts else None,
        native=through,
        mask=mask,
        ignore_alpha=ignore_alpha,
    )
    if max(np.abs(camera.T).max(), np.abs(camera.center).max()) > FARTHEST:
        raise UserError(
            f"the camera of {name} is more than {FARTHEST:g} from the origin; take the photo out of the scene, or "
            "move the scene to its origin"
        )
    return camera


def finished(cameras: Sequence[CameraInfo], opaque: bool = False) -> list[CameraInfo]:
    """The views with the sizes of their photos, all of them pinholes or native: other photos are undistorted.

    opaque: alpha of the photos is dropped, before undistortion mixes it with colours.

    Photos that lie on their side against their camera are turned, if their EXIF orientation says so. A message says
    which photos have another shape than their camera. UserError for photos that cannot be read or stay on their side,
    and for a mask that cannot be used.
    """
    sizes = picture_sizes([camera.image_path for camera in cameras])
    cameras = [replace(camera, file_size=size, opaque=opaque) for camera, size in zip(cameras, sizes, strict=True)]
    cameras = turned_by_exif(cameras)
    _refuse_turned(cameras)
    _warn_of_other_shapes(cameras)
    for camera in cameras:
        if camera.mask is not None:
            _check_mask(camera.mask.path, camera.file_size, camera.lying)
    if distorted := [index for index, camera in enumerate(cameras) if camera.lens]:
        for index, camera in zip(distorted, undistort([cameras[index] for index in distorted]), strict=True):
            cameras[index] = camera
    return cameras


def _check_mask(mask: Path, size: tuple[int, int], lying: Path | None = None) -> None:
    mask_size = picture_size(mask)
    # A smaller mask has whole pixels, too: half of 269 is 134 or 135.
    if abs(size[0] * mask_size[1] - size[1] * mask_size[0]) > max(*size, *mask_size):
        upright = " when upright" if lying else ""
        raise UserError(
            f"the mask {mask} is {mask_size[0]} x {mask_size[1]} pixels and its photo {size[0]} x {size[1]}{upright}; "
            f"make masks of the same shape as the {'upright ' if lying else ''}photos"
        )


def _refuse_turned(cameras: Sequence[CameraInfo]) -> None:
    """UserError if photos would be stretched from upright to lying, or the other way round."""
    wrong = [camera for camera in cameras if exchanged(camera)]
    if wrong:
        lens, names = wrong[0].lens or wrong[0], [camera.image_name for camera in wrong]
        raise UserError("; ".join(turned(names, len(cameras), wrong[0].file_size, (lens.width, lens.height))))


def _warn_of_other_shapes(cameras: Sequence[CameraInfo]) -> None:
    shapes = [(camera, camera.file_size, camera.lens or camera) for camera in cameras]
    others = [
        (camera.image_name, f"{size[0]} x {size[1]}, camera {shape.width} x {shape.height}")
        for camera, size, shape in shapes
        if abs(size[0] * shape.height / shape.width - size[1]) > 1
    ]
    if others:
        (name, sizes), count = others[0], f"{len(others)} of {len(cameras)} photos"
        fault = "do not have the aspect ratio of their camera and will be stretched"
        print(f"{count} {fault}; the first is {name} ({sizes})", file=sys.stderr)
