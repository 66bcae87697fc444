"""COLMAP scenes: a model in the folder sparse, photos in a folder beside it."""

import os
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from groundwork.files.unread import note_unread
from scene.colmap_loader import Camera, Image, Points, qvec2rotmat, read_cameras, read_images, read_points
from scene.images.find import find_images
from scene.images.lens import Lens
from scene.images.masks import NO_MASKS, Mask, MaskOptions, find_masks
from scene.readers.holdout import EVERY, refuse_rule, split
from scene.readers.info import CameraInfo, Posed, SceneInfo
from scene.readers.photos import camera_info, to_pinholes
from scene.readers.point_cloud import check_finite, read_point_cloud
from scene.readers.scene_folder import REPORT, describe_verdict
from scene.readers.start_cloud import OWN_POINTS, StartCloud, StartOptions, random_in_frusta, scene_info
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

_NEEDED, _POINTS, _SUFFIXES = ("cameras", "images"), "points3D", ("bin", "txt")
AGAIN = "copy all files of the model again from where they were made"


_NO_POINTS = Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


class ColmapModel(NamedTuple):
    """Cameras by their ids; photos in the order of theirs; points in the order of theirs, none without their file."""

    cameras: dict[int, Camera]
    images: list[Image]
    points: Points


def read_colmap(
    folder: Path,
    images: str,
    hold_out: bool,
    start: StartOptions | None = OWN_POINTS,
    masks: MaskOptions = NO_MASKS,
    native: bool = False,
    rule: str = EVERY,
) -> SceneInfo:
    """Read a COLMAP scene: the model, photos in `<folder>/<images>`, views sorted by name (bytes).

    Arguments and errors as for `scene.dataset_readers.read_scene`; start None: without points.
    """
    model_folder, model = find_model(folder, with_points=start is not None)
    note_unread(model_folder, "colmap", _list_side_files(model_folder))
    if (listed := model_folder / "test.txt").is_file():  # of the reference, whose train.py does not read it either
        refuse_rule(rule, listed)
    if not model.images:
        raise UserError(f"the COLMAP model in {model_folder} has no registered photo; reconstruct the scene again")
    photos = sorted(model.images, key=lambda image: os.fsencode(image.name))
    names = [photo.name for photo in photos]
    listed_by = f"the COLMAP model in {model_folder}"
    without = (
        "list their names in a file, and run `colmap image_deleter "
        f"--input_path {model_folder} --output_path {model_folder} --image_names_path LIST`"
    )
    if (folder / REPORT).is_file():
        without = "remove them from input, too, and run convert.py again"
    others = [path.name for path in sorted(folder.iterdir()) if path.name != images and (path / names[0]).is_file()]
    there = f" (-i {others[0]} has {names[0]})" if others else ""
    remedy = f"put them there, name their folder with -i{there}, or go on without: {without}"
    paths = find_images(folder / images, names, listed_by, remedy)
    by_file: dict[str, str] = {}
    for name, path in zip(names, paths, strict=True):
        if (first := by_file.setdefault(os.path.normpath(path), name)) != name:
            raise UserError(f"{first} and {name} in {listed_by} are one file, {path}; rename one, or take it out")
    found = find_masks(folder, names, masks, paths, images)
    cameras = [
        colmap_camera(photo, model.cameras[photo.camera_id], path, mask, masks.ignore_alpha, native)
        for photo, path, mask in zip(photos, paths, found, strict=True)
    ]
    views = split(to_pinholes(cameras, masks.drop_alpha), hold_out, rule, folder)
    own, lacking = partial(_read_own_cloud, folder, model_folder, model), f"{listed_by} has no points"
    return scene_info(views, start, own, partial(random_in_frusta, views[0]), lacking)


def colmap_camera(
    photo: Image, camera: Camera, path: Path, mask: Mask | None = None, ignore_alpha: bool = False, native: bool = False
) -> CameraInfo:
    """Make the view of a photo that COLMAP registered. native: keep a lens that the rasterizer draws."""
    return camera_info(camera.id, photo.name, path, _make_lens(camera), *_read_pose(photo), mask, ignore_alpha, native)


def read_poses(folder: Path) -> list[Posed]:
    """The poses and lenses of a model's photos, whose points may be missing. UserError where it cannot be read."""
    model = read_model(folder)
    lenses = {number: _make_lens(camera) for number, camera in model.cameras.items()}
    return [
        Posed(photo.name, *_read_pose(photo), lambda _, lens=lenses[photo.camera_id]: lens) for photo in model.images
    ]


def _make_lens(camera: Camera) -> Lens:
    return Lens(camera.model, tuple(map(float, camera.params)), camera.width, camera.height)


def _read_pose(photo: Image) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world rotation (3,3) and world-to-camera translation (3,)."""
    return qvec2rotmat(photo.qvec).T.copy(), np.asarray(photo.tvec, dtype=np.float64)


def _read_own_cloud(folder: Path, model_folder: Path, model: ColmapModel) -> StartCloud | None:
    """Read the points of a COLMAP model, from which a training starts; None if the model has no file of points.

    The model's PLY is used in place of its points if it is not older; an older PLY is named in a message. UserError
    if there are no points, and convert.py has left its verdict on the model.

    folder: folder of the scene.
    model_folder: folder of the model's files.
    """
    source, ply = _find_file(model_folder, _POINTS, "bin"), model_folder / f"{_POINTS}.ply"
    if ply.is_file():
        if source is None or not len(model.points.ids) or ply.stat().st_mtime >= source.stat().st_mtime:
            return StartCloud(read_point_cloud(ply), ply)
        remedy = f"to use it, give --init_pcd_path {ply}"
        print(f"{ply} is older than {source.name} and is not used; {remedy}", file=sys.stderr)
    if not len(model.points.ids) and (verdict := describe_verdict(folder)):  # no other points would end this fault
        raise UserError(verdict)
    if source is None:
        return None
    check_finite(model.points.xyz, source)
    colors = model.points.rgb.astype(np.uint8).astype(np.float32) / 255
    return StartCloud(BasicPointCloud(model.points.xyz, colors, np.zeros_like(colors)), None)


def find_model(scene: Path, with_points: bool = True) -> tuple[Path, ColmapModel]:
    """Folder and contents of the COLMAP model with the most registered photos, in `sparse` or one of its sub-folders.

    Among equals `sparse/0` comes first, then `sparse`. A message says which of several models is used. UserError saying
    what was found when there is no model, or none that can be read. with_points: as for `read_model`.
    """
    sparse = scene / "sparse"
    inside = sorted(path for path in sparse.iterdir() if path.is_dir())
    folders = [folder for folder in dict.fromkeys([sparse / "0", sparse, *inside]) if not _list_lacking(folder)]
    if not folders:
        for folder in (sparse / "0", sparse, *inside):
            missing = _list_lacking(folder)
            if len(missing) < len(_NEEDED):
                raise UserError(f"{folder} has no {missing[0]} as .bin or .txt; copy the whole model there")
        found = sorted(str(path.relative_to(scene)) for path in sparse.glob("**/*"))[:8]
        raise UserError(
            f"no COLMAP model in {sparse / '0'}, {sparse} or its other folders: looked for cameras and images "
            f"as .bin or .txt, found {', '.join(found) or 'nothing'}; copy the whole model there"
        )
    models, errors = {}, []
    for folder in folders:
        try:
            # Of several, one whose points are broken is not used: by a training and by a render alike.
            models[folder] = read_model(folder, with_points=with_points or len(folders) > 1)
        except UserError as error:
            errors.append(error)
    if not models:
        raise errors[0]
    for error in errors:
        print(f"{error}; another model is used", file=sys.stderr)
    best = max(models, key=lambda folder: len(models[folder].images))  # the first among equals
    if len(models) > 1:
        others = ", ".join(f"{folder} {len(models[folder].images)}" for folder in models if folder != best)
        print(f"{best} registers {len(models[best].images)} photos and is used; {others}", file=sys.stderr)
    _say_if_text_is_newer(best)
    return best, models[best]


def _say_if_text_is_newer(folder: Path) -> None:
    """Say that text files of a model are newer than its binary files, which are read."""
    binary = [folder / f"{name}.bin" for name in (*_NEEDED, _POINTS)]
    text = [path.with_suffix(".txt") for path in binary]
    both = [(b, t) for b, t in zip(binary, text, strict=True) if b.is_file() and t.is_file()]
    newer = [t.name for b, t in both if t.stat().st_mtime > b.stat().st_mtime]
    if newer:
        print(
            f"{folder} has its model twice: the .bin files are used, although {', '.join(newer)} is newer; to use the "
            ".txt files, move the .bin files elsewhere",
            file=sys.stderr,
        )


def read_model(folder: Path, with_2d_points: bool = False, with_points: bool = True) -> ColmapModel:
    """Read a binary model, or a text model if that is missing or broken. UserError when neither can be read.

    A file that is missing in one kind is taken in the other. with_points: False leaves out the points of a text file,
    which take a second for 300,000.
    """
    kinds, errors = _list_kinds(folder), []
    for suffix in kinds:
        try:
            model = read_model_of_kind(folder, suffix, with_2d_points, with_points)
        except UserError as error:
            errors.append(error)
            continue
        for error in errors:
            print(f"{error}; the .{suffix} files are used", file=sys.stderr)
        return model
    raise errors[0] if errors else UserError(f"no COLMAP model in {folder}; copy the whole model there")


def read_model_of_kind(
    folder: Path, suffix: str, with_2d_points: bool = False, with_points: bool = True
) -> ColmapModel:
    """Read a model in .bin or .txt files, and what it lacks in the other kind.

    UserError where one cannot be read or a photo's camera is missing.
    """
    if suffix not in _list_kinds(folder):
        raise UserError(f"no COLMAP model in {folder} as .{suffix}; choose the other kind with --model_type")
    paths = [_find_file(folder, name, suffix) for name in (*_NEEDED, _POINTS)]
    binary = [path is not None and path.suffix == ".bin" for path in paths]
    try:
        cameras = read_cameras(paths[0], binary[0])
        images = read_images(paths[1], binary[1], with_2d_points)
        points = read_points(paths[2], binary[2]) if paths[2] and (with_points or binary[2]) else _NO_POINTS
    except OSError as error:
        raise UserError(f"cannot read {error.filename} ({error.strerror}); fix its permissions, or {AGAIN}") from error
    for image in images.values():
        if image.camera_id not in cameras:
            raise UserError(
                f"the photo {image.name} in {paths[1]} has the camera {image.camera_id}, which is "
                f"not in {paths[0].name}; {AGAIN}"
            )
    order = np.argsort(points.ids, kind="stable")
    return ColmapModel(
        cameras, [image for _, image in sorted(images.items())], Points(*(part[order] for part in points))
    )


def _find_file(folder: Path, name: str, suffix: str) -> Path | None:
    """Find a file of a model, of this kind if there is one, else of the other; None if there is neither."""
    paths = (folder / f"{name}.{kind}" for kind in sorted(_SUFFIXES, key=lambda kind: kind != suffix))
    return next((path for path in paths if path.is_file()), None)


def _list_kinds(folder: Path) -> list[str]:
    """The kinds of a model's files, the binary one first; none where a file that every model has is missing."""
    there = [kind for kind in _SUFFIXES if any((folder / f"{name}.{kind}").is_file() for name in (*_NEEDED, _POINTS))]
    return [] if _list_lacking(folder) else there


def _list_side_files(folder: Path) -> set[str]:
    """The names of files that lie beside a model and are no part of it; those of the system are hidden."""
    own = {f"{name}.{kind}" for name in (*_NEEDED, _POINTS) for kind in _SUFFIXES} | {f"{_POINTS}.ply"}
    return {path.name for path in folder.iterdir() if path.is_file() and path.name[0] != "."} - own


def _list_lacking(folder: Path) -> list[str]:
    """The files of a model that a folder lacks."""
    return [name for name in _NEEDED if not _find_file(folder, name, "bin")]
