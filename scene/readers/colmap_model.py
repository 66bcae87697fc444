"""COLMAP models as plain records.

rigs and frames of COLMAP 4 are not read: its images file has the poses that follow from them.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene.images.lens import Lens
from scene.readers.colmap_binary import (
    read_extrinsics_binary,
    read_intrinsics_binary,
    read_point_table_binary,
    read_poses_binary,
)
from scene.readers.colmap_records import Camera, Image, PointTable, qvec2rotmat
from scene.readers.colmap_text import (
    read_extrinsics_text,
    read_intrinsics_text,
    read_point_table_text,
    read_poses_text,
)
from utils.system_utils import UserError

_READERS = {
    "bin": (read_intrinsics_binary, read_poses_binary, read_extrinsics_binary, read_point_table_binary),
    "txt": (read_intrinsics_text, read_poses_text, read_extrinsics_text, read_point_table_text),
}
_AGAIN = "copy all three files of the model again from where they were made"


class ColmapView(NamedTuple):
    """A registered photo: COLMAP's name, camera id and lens, world-to-camera rotation (3,3) and translation (3,)."""

    name: str
    camera_id: int
    lens: Lens
    rotation: np.ndarray
    translation: np.ndarray


class ColmapModel(NamedTuple):
    """Views in the order of their image ids; points (N,3) float64 and colours (N,3) uint8 in the order of point ids."""

    views: list[ColmapView]
    points: np.ndarray
    colors: np.ndarray


def find_model(scene: Path) -> tuple[Path, ColmapModel]:
    """Folder and contents of the COLMAP model with the most registered photos, in `sparse` or one of its sub-folders.

    Among equals `sparse/0` comes first, then `sparse`. A message says which of several models is used. UserError saying
    what was found when there is no model, or none that can be read.
    """
    sparse = scene / "sparse"
    inside = sorted(path for path in sparse.iterdir() if path.is_dir())
    folders = list(dict.fromkeys([sparse / "0", sparse, *inside]))
    folders = [folder for folder in folders if any(_has_model(folder, suffix) for suffix in ("bin", "txt"))]
    if not folders:
        found = sorted(str(path.relative_to(scene)) for path in sparse.glob("**/*"))[:8]
        raise UserError(
            f"no COLMAP model in {sparse / '0'}, {sparse} or its other folders: looked for cameras, images and "
            f"points3D as .bin or .txt, found {', '.join(found) or 'nothing'}; copy the whole model there"
        )
    models, errors = {}, []
    for folder in folders:
        try:
            models[folder] = read_model(folder)
        except UserError as error:
            errors.append(error)
    if not models:
        raise errors[0]
    for error in errors:
        print(f"{error}; another model is used", file=sys.stderr)
    best = max(models, key=lambda folder: len(models[folder].views))  # the first among equals
    if len(models) > 1:
        others = ", ".join(f"{folder} {len(models[folder].views)}" for folder in models if folder != best)
        print(f"{best} registers {len(models[best].views)} photos and is used; {others}", file=sys.stderr)
    return best, models[best]


def read_model(folder: Path) -> ColmapModel:
    """Read a binary model, or a text model if that is missing or broken. UserError when neither can be read."""
    errors = []
    for suffix in _READERS:
        if _has_model(folder, suffix):
            try:
                return _read_model(folder, suffix)
            except UserError as error:
                errors.append(error)
    raise errors[0] if errors else UserError(f"no COLMAP model in {folder}; copy the whole model there")


def _read_model(folder: Path, suffix: str) -> ColmapModel:
    cameras, images, points = _records(folder, suffix)
    views = []
    for _, image in sorted(images.items()):
        camera = cameras[image.camera_id]
        lens = Lens(camera.model, tuple(camera.params.tolist()), camera.width, camera.height)
        views.append(ColmapView(image.name, image.camera_id, lens, qvec2rotmat(image.qvec), image.tvec))
    order = np.argsort(points.ids, kind="stable")
    return ColmapModel(views, points.xyz[order], points.rgb[order].astype(np.uint8))


def _records(
    folder: Path, suffix: str, with_2d_points: bool = False
) -> tuple[dict[int, Camera], dict[int, Image], PointTable]:
    """The contents of a model's three files. UserError where one cannot be read or a photo's camera is missing."""
    read_cameras, read_poses, read_photos, read_points = _READERS[suffix]
    read_images = read_photos if with_2d_points else read_poses
    try:
        cameras = read_cameras(folder / f"cameras.{suffix}")
        images = read_images(folder / f"images.{suffix}")
        points = read_points(folder / f"points3D.{suffix}")
    except OSError as error:
        raise UserError(f"cannot read {error.filename} ({error.strerror}); fix its permissions, or {_AGAIN}") from error
    for image in images.values():
        if image.camera_id not in cameras:
            raise UserError(
                f"the photo {image.name} in {folder / f'images.{suffix}'} has the camera {image.camera_id}, which is "
                f"not in cameras.{suffix}; {_AGAIN}"
            )
    return cameras, images, points


class Sightings(NamedTuple):
    """Points seen in a registered photo: their pixels (n,2) of width x height, centres at .5, and depths z (n,)."""

    name: str
    width: int
    height: int
    pixels: np.ndarray
    depths: np.ndarray


def read_sightings(folder: Path, suffix: str) -> list[Sightings]:
    """Sightings of all photos of a model in .bin or .txt files. UserError when it cannot be read."""
    if not _has_model(folder, suffix):
        raise UserError(f"no COLMAP model in {folder} as .{suffix}; choose the other kind with --model_type")
    cameras, images, points = _records(folder, suffix, with_2d_points=True)
    order = np.argsort(points.ids, kind="stable")
    ids, positions = points.ids[order], points.xyz[order]
    sightings = []
    for _, image in sorted(images.items()):
        seen = image.point3D_ids >= 0
        wanted = image.point3D_ids[seen]
        places = np.searchsorted(ids, wanted)
        if (places == np.searchsorted(ids, wanted, side="right")).any():
            raise UserError(
                f"the photo {image.name} in {folder / f'images.{suffix}'} sees a point that is not in "
                f"points3D.{suffix}; {_AGAIN}"
            )
        camera = cameras[image.camera_id]
        depths = positions[places] @ qvec2rotmat(image.qvec)[2] + image.tvec[2]
        sightings.append(Sightings(image.name, camera.width, camera.height, image.xys[seen], depths))
    return sightings


def points_file(folder: Path) -> Path:
    """The file that holds the model's points."""
    return next(path for path in (folder / "points3D.bin", folder / "points3D.txt") if path.is_file())


def _has_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images", "points3D"))
