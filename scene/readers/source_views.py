"""Conversion of views as a dataset lists them, with any lens, to pinhole views."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene.images.decode import picture_size
from scene.images.lens import Lens, Pinhole, pinhole_of
from scene.images.masks import Mask
from scene.images.undistortion import Photo, undistort
from scene.readers.info import CameraInfo
from utils.graphics_utils import rigid_pose
from utils.system_utils import UserError

FARTHEST = 1e12  # from the origin, beyond which lie damaged files; there a double has steps of 1e-4


class SourceView(NamedTuple):
    """A photo as a dataset lists it: file, lens, world-to-camera rotation (3,3) and translation (3,), mask."""

    name: str
    path: Path
    uid: int
    lens: Lens
    rotation: np.ndarray
    translation: np.ndarray
    mask: Mask | None = None


def make_cameras(views: Sequence[SourceView], ignore_alpha: bool) -> list[CameraInfo]:
    """The views as pinholes; photos of other lenses are undistorted first (scene/images/undistortion.py).

    ignore_alpha: transparent pixels of a photo do not count. UserError names the view that cannot be used.
    """
    pinholes = [pinhole_of(view.lens, view.name) for view in views]
    views = [_posed(view) for view in views]
    sizes = [picture_size(view.path) for view in views]
    _warn_of_other_shapes(views, sizes)
    for view, size in zip(views, sizes, strict=True):
        if view.mask is not None:
            _check_mask(view, size)

    distorted = [index for index, pinhole in enumerate(pinholes) if pinhole is None]
    photos = [
        Photo(views[index].path, sizes[index], views[index].lens, views[index].mask, ignore_alpha)
        for index in distorted
    ]
    undistorted = dict(zip(distorted, undistort(photos) if photos else [], strict=True))
    cameras = []
    for index, view in enumerate(views):
        if index in undistorted:
            path, pinhole, mask = undistorted[index]
            size, ignore = (pinhole.width, pinhole.height), False
        else:
            path, pinhole, mask, size, ignore = view.path, pinholes[index], view.mask, sizes[index], ignore_alpha
        cameras.append(camera_of(view, pinhole, path, size, mask, ignore))
    return cameras


def camera_of(
    view: SourceView,
    pinhole: Pinhole,
    path: Path,
    size: tuple[int, int] | None,
    mask: Mask | None = None,
    ignore_alpha: bool = False,
) -> CameraInfo:
    """The record of a view as a pinhole, with a photo of a size (width, height); None: read when first asked for."""
    return CameraInfo(
        uid=view.uid,
        R=view.rotation.T.copy(),
        T=view.translation.copy(),
        **pinhole._asdict(),
        image_path=path,
        image_name=view.name,
        file_size=size,
        mask=mask,
        ignore_alpha=ignore_alpha,
    )


def _posed(view: SourceView) -> SourceView:
    """The view with a rotation in its pose. UserError for a pose that is none."""
    turn, translation = rigid_pose(view.rotation.T, view.translation, view.name)
    center = turn @ translation
    if np.abs(translation).max() > FARTHEST or np.abs(center).max() > FARTHEST:
        raise UserError(
            f"the camera of {view.name} is more than {FARTHEST:g} from the origin; take the photo out of the scene, or "
            "move the scene to its origin"
        )
    return view._replace(rotation=turn.T, translation=translation)


def _check_mask(view: SourceView, size: tuple[int, int]) -> None:
    mask_size = picture_size(view.mask.path)
    if abs(size[0] * mask_size[1] / mask_size[0] - size[1]) > 1:
        raise UserError(
            f"the mask {view.mask.path} is {mask_size[0]} x {mask_size[1]} pixels and its photo {size[0]} x {size[1]}; "
            "make masks of the same shape as the photos"
        )


def _warn_of_other_shapes(views: Sequence[SourceView], sizes: Sequence[tuple[int, int]]) -> None:
    others = [
        (view, size)
        for view, size in zip(views, sizes, strict=True)
        if abs(size[0] * view.lens.height / view.lens.width - size[1]) > 1
    ]
    if others:
        view, size = others[0]
        print(
            f"{len(others)} of {len(views)} photos do not have the aspect ratio of their camera and will be stretched; "
            f"the first is {view.name} ({size[0]} x {size[1]}, camera {view.lens.width} x {view.lens.height})",
            file=sys.stderr,
        )
