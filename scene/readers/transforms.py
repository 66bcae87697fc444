"""Scenes whose camera file has poses in OpenGL axes: Blender's transforms_train.json, nerfstudio's transforms.json."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scene.images.decode import picture_size
from scene.images.find import find_pictures
from scene.images.masks import NO_MASKS, Mask, MaskOptions, find_masks
from scene.readers.info import CameraInfo, SceneInfo, held_out, normalization, split_by_order
from scene.readers.point_cloud import read_point_cloud
from scene.readers.source_views import SourceView, make_cameras
from scene.readers.start_cloud import (
    OWN_POINTS,
    StartCloud,
    StartOptions,
    choose_start,
    random_in_cube,
    random_in_frusta,
)
from scene.readers.transforms_lens import lens_of
from splatting.files.image_files import SUFFIXES
from splatting.files.plain_files import plain_text
from splatting.files.relative import relative_to
from utils.system_utils import UserError

SPLITS = ("train_filenames", "val_filenames", "test_filenames")


class _Frame(NamedTuple):
    file_path: str
    world_to_camera: np.ndarray
    fields: dict[str, Any]


class _CameraFile(NamedTuple):
    path: Path
    fields: dict[str, Any]
    frames: list[_Frame]


def read_blender(
    folder: Path,
    images: str,
    hold_out: bool,
    start: StartOptions | None = OWN_POINTS,
    masks: MaskOptions = NO_MASKS,
    suffixes: Sequence[str] = SUFFIXES,
) -> SceneInfo:
    """Read a Blender scene (transforms_train.json, transforms_test.json), views in the order of the files.

    A scene without a cloud of its own starts from grey points spread evenly over a cube. suffixes: of photos that the
    files name without one. Other arguments and errors as for `scene.dataset_readers.read_scene`; images has no effect.
    """
    files = [folder / "transforms_train.json", folder / "transforms_test.json"]
    for path in files:
        if not path.is_file():
            raise UserError(f"no {path.name} in {folder}; a Blender scene needs {files[0].name} and {files[1].name}")
    train, test = (read_frames(path, masks, suffixes) for path in files)
    train, test = (train, held_out(test)) if hold_out else (train + test, [])
    if not train:
        raise UserError(f"{files[0]} lists no frames; export the scene again")
    if start is None:
        return SceneInfo(None, train, test, normalization(train), None, is_nerf_synthetic=True)

    def own() -> StartCloud:
        ply = folder / "points3d.ply"
        return StartCloud(read_point_cloud(ply), ply) if ply.is_file() else StartCloud(random_in_cube(), None)

    cloud, ply_path = choose_start(start, own, random_in_cube, f"{folder / 'points3d.ply'} has no points")
    return SceneInfo(cloud, train, test, normalization(train, cloud.points), ply_path, is_nerf_synthetic=True)


def read_frames(path: Path, masks: MaskOptions = NO_MASKS, suffixes: Sequence[str] = SUFFIXES) -> list[CameraInfo]:
    """The views of one of a Blender scene's two files, in its order."""
    return _cameras(_read(path), masks, suffixes, by_stem=True)


def read_nerfstudio(
    folder: Path, images: str, hold_out: bool, start: StartOptions | None = OWN_POINTS, masks: MaskOptions = NO_MASKS
) -> SceneInfo:
    """Read a nerfstudio or instant-ngp scene (transforms.json), views sorted by name (bytes).

    hold_out: the file's own split if it has one (test_filenames, else val_filenames, are the test views), else every
    8th view. Frames may name masks, which --masks replaces. Points come from the file's ply_file_path. Arguments and
    errors as for `scene.dataset_readers.read_scene`; images has no effect.
    """
    content = _read(folder / "transforms.json")
    cameras = sorted(
        _cameras(content, masks, SUFFIXES, by_stem=False), key=lambda camera: os.fsencode(camera.image_name)
    )
    if not cameras:
        raise UserError(f"{content.path} lists no frames; export the scene again")
    train, test = _own_split(content, cameras, hold_out) or split_by_order(cameras, hold_out, folder)
    if start is None:
        return SceneInfo(None, train, test, normalization(train), None)

    def own() -> StartCloud | None:
        name = content.fields.get("ply_file_path")
        return StartCloud(read_point_cloud(folder / str(name)), folder / str(name)) if name else None

    lacking = f"{content.path} names no points (ply_file_path)"
    cloud, ply_path = choose_start(start, own, lambda: random_in_frusta(train), lacking)
    return SceneInfo(cloud, train, test, normalization(train, cloud.points), ply_path)


def _read(path: Path) -> _CameraFile:
    try:
        content = json.loads(plain_text(path))
        listed = list(content["frames"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _no_camera_file(path, error) from error
    return _CameraFile(path, content, [_frame(path, number, frame) for number, frame in enumerate(listed, start=1)])


def _frame(path: Path, number: int, frame: Any) -> _Frame:
    name = f" ({frame['file_path']})" if isinstance(frame, dict) and "file_path" in frame else ""
    where = f"frame {number}{name:.80} of {path}"
    try:
        lacking = [key for key in ("file_path", "transform_matrix") if key not in frame]
        if lacking:
            raise UserError(f"{where} has no {' and no '.join(lacking)}; fix the frame, or take it out")
        return _Frame(str(frame["file_path"]), _world_to_camera(frame["transform_matrix"]), dict(frame))
    except (ValueError, TypeError, OverflowError, np.linalg.LinAlgError) as error:
        raise UserError(
            f"{where} has no usable pose ({type(error).__name__}: {error}); it needs a transform_matrix of 4x4 finite "
            "numbers that can be inverted"
        ) from error


def _no_camera_file(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is not a camera file ({type(error).__name__}: {error}); it needs camera_angle_x or fl_x, and frames, "
        "each with file_path and a 4x4 transform_matrix"
    )


def _cameras(file: _CameraFile, masks: MaskOptions, suffixes: Sequence[str], by_stem: bool) -> list[CameraInfo]:
    """The views in the order of the frames, named by the stems or by the relative paths of their files."""
    folder = file.path.parent
    listed = [frame.file_path for frame in file.frames]
    paths = find_pictures(folder, listed, str(file.path), "put them there", suffixes)
    names = [_relative(path, folder) for path in paths]
    views = []
    for index, (frame, path, mask) in enumerate(zip(file.frames, paths, _masks(file, names, masks), strict=True)):
        try:
            lens = lens_of(frame.fields, file.fields, picture_size(path), file.path)
        except (ValueError, TypeError, OverflowError) as error:
            raise _no_camera_file(file.path, error) from error
        pose = frame.world_to_camera
        name = path.stem if by_stem else names[index]
        views.append(SourceView(name, path, index, lens, pose[:3, :3], pose[:3, 3], mask))
    return make_cameras(views, masks.ignore_alpha)


def _relative(path: Path, folder: Path) -> str:
    return relative_to(path, folder).as_posix()


def _masks(file: _CameraFile, names: list[str], masks: MaskOptions) -> list[Mask | None]:
    folder = file.path.parent
    listed = [frame.fields.get("mask_path") for frame in file.frames]
    if masks.folder or not any(listed):
        return find_masks(folder, names, masks)
    named = [str(name) for name in listed if name]
    found = find_pictures(folder, named, str(file.path), "put them there", kind="masks")
    paths = iter(found)
    return [masks.mask(next(paths)) if name else None for name in listed]


def _own_split(
    file: _CameraFile, cameras: list[CameraInfo], hold_out: bool
) -> tuple[list[CameraInfo], list[CameraInfo]] | None:
    """Training and test views by the file's lists; None without hold_out or without such lists."""
    lists = []
    for name in SPLITS:
        listed = file.fields.get(name) or []
        if not isinstance(listed, list):
            raise UserError(f"{name} in {file.path} must be a list of file names; fix it, or leave it out")
        lists.append({os.path.normpath(str(entry)) for entry in listed})
    train_names, test_names = lists[0], lists[2] or lists[1]
    if not hold_out or not test_names:
        return None
    test, train = [], []
    for camera in cameras:
        name = os.path.normpath(camera.image_name)
        if name in test_names:
            test.append(camera)
        elif name in train_names or not train_names:
            train.append(camera)
    if not test or not train:
        raise UserError(
            f"of the photos in {file.path}, {len(train)} are in train_filenames and {len(test)} in test_filenames (or "
            "val_filenames), but each list needs at least one; fix the lists or leave --eval out"
        )
    return train, held_out(test)


def _world_to_camera(rows: list[list[float]]) -> np.ndarray:
    """World-to-camera matrix (4,4), y down and z forward, of an OpenGL camera-to-world matrix (y up, z backward)."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"transform_matrix must be 4x4 finite numbers, got shape {matrix.shape}")
    matrix[:3, 1:3] *= -1
    inverse = np.linalg.inv(matrix)
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-3:
        raise ValueError(f"the last row of transform_matrix must be 0 0 0 1, got {matrix[3]}")
    return inverse
