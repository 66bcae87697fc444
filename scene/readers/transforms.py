"""Scenes whose camera file has poses in OpenGL axes: Blender's transforms_train.json, nerfstudio's transforms.json.

Exports of other programs are read as the transforms.json that they stand for.
"""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.image_files import SUFFIXES
from groundwork.files.json_files import read_json
from groundwork.files.unread import note_unread
from groundwork.host.listing import some
from scene.images.decode import picture_sizes
from scene.images.find import FileIndex, find_images, find_in, find_listed, identity, other_folder
from scene.images.lens import Lens
from scene.images.masks import NO_MASKS, Mask, MaskOptions, find_masks
from scene.readers.holdout import EVERY, held_out, refuse_rule, split
from scene.readers.info import CameraInfo, Posed, SceneInfo
from scene.readers.metashape import read_metashape
from scene.readers.phone_scans import read_polycam, read_record3d
from scene.readers.photos import camera_info, to_pinholes
from scene.readers.point_cloud import read_point_cloud
from scene.readers.scene_folder import camera_file
from scene.readers.start_cloud import (
    OWN_POINTS,
    StartCloud,
    StartOptions,
    random_for_blender,
    random_in_frusta,
    scene_info,
)
from scene.readers.transforms_lens import FIELDS, circle_of, lens_of
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

SPLITS = ("train_filenames", "val_filenames", "test_filenames")
_READ = {"file_path", "transform_matrix", "mask_path", "ply_file_path", "frames", "test_frames", *SPLITS, *FIELDS}
_MASKS = ("mask_path", "fisheye_crop_radius")
_ESCAPED = {8: "\\b", 9: "\\t", 10: "\\n", 12: "\\f", 13: "\\r"}  # what a lone backslash in a path made of its letter
_SAME = 1e-6  # of poses, which decimals may have rounded


def read_blender(
    folder: Path,
    images: str,
    hold_out: bool,
    start: StartOptions | None = OWN_POINTS,
    masks: MaskOptions = NO_MASKS,
    suffixes: Sequence[str] = SUFFIXES,
) -> SceneInfo:
    """Read a Blender scene (transforms_train.json, transforms_test.json), views in the order of the files.

    Without hold_out, test views train, too, and are left out with a message where their file or photos are missing. A
    scene without a cloud of its own starts from grey points spread evenly over a cube. suffixes: of photos that the
    files name without one. Other arguments and errors as for `scene.dataset_readers.read_scene`.
    """
    files = [folder / "transforms_train.json", folder / "transforms_test.json"]
    for path in files[: 2 if hold_out else 1]:
        if not path.is_file():
            raise UserError(f"no {path.name} in {folder}, which --eval needs; export it, or leave --eval out")
    train = read_frames(files[0], masks, suffixes, images)
    test = _read_test_frames(files[1], masks, suffixes, images, hold_out)
    if hold_out:
        train, test = _drop_tests(_dedupe(train, str(files[0])), held_out(_dedupe(test, str(files[1]))), folder)
    else:
        train, test = _dedupe(train + test, str(folder)), []
    if not train:
        raise UserError(f"{files[0]} lists no frames; export the scene again")

    def random() -> BasicPointCloud:
        return random_for_blender(train, files[0])

    def own() -> StartCloud:
        ply = _find_ply(folder)
        return StartCloud(read_point_cloud(ply), ply) if ply else StartCloud(random(), None, is_random=True)

    lacking = f"{folder / 'points3d.ply'} has no points"
    return scene_info((train, test), start, own, random, lacking, is_nerf_synthetic=True)


def read_poses(path: Path) -> list[Posed]:
    """The poses and lenses of a camera file, without a look at its photos. UserError for what cannot be used.

    A message names the masks that the file gives, which nobody reads here.
    """
    content = _read_frame_list(path)
    note_unread(path, "transforms", {name for one in (content, *content["frames"]) for name in _MASKS if one.get(name)})
    frames = enumerate(content["frames"], start=1)
    return [
        Posed(str(frame["file_path"]), *_read_pose(path, number, frame), partial(_read_lens, path, content, frame))
        for number, frame in frames
    ]


def read_frames(
    path: Path, masks: MaskOptions = NO_MASKS, suffixes: Sequence[str] = SUFFIXES, images: str = ""
) -> list[CameraInfo]:
    """The views of one of a Blender scene's two files, in its order."""
    return _make_cameras(path, _read_frame_list(path), masks, suffixes, images, by_stem=True)


def _read_test_frames(
    path: Path, masks: MaskOptions, suffixes: Sequence[str], images: str, needed: bool
) -> list[CameraInfo]:
    """Read the test views of a file. needed: errors are raised; else they are printed, and the list is empty."""
    if not needed and not path.is_file():
        return []
    try:
        return read_frames(path, masks, suffixes, images)
    except UserError as error:
        if needed:
            raise UserError(f"{error}, or leave --eval out") from error
        print(f"the views of {path} are not used for training: {error}", file=sys.stderr)
        return []


def _drop_tests(
    train: list[CameraInfo], test: list[CameraInfo], listed_by: Path
) -> tuple[list[CameraInfo], list[CameraInfo]]:
    """Leave out training views whose photo is also a test view's."""
    tests = {_clean_path(view) for view in test}
    left = [view for view in train if _clean_path(view) not in tests]
    if train and not left:
        raise UserError(
            f"all training photos of {listed_by} are test photos, too; list other training photos, or leave --eval out"
        )
    if len(left) < len(train):
        count = len(train) - len(left)
        print(f"{count} photos of {listed_by} are listed for training and tests; only tests use them", file=sys.stderr)
    return left, test


def _dedupe(views: list[CameraInfo], listed_by: str) -> list[CameraInfo]:
    """Leave out further views of the same photo. UserError if their poses differ."""
    found: dict[str, CameraInfo] = {}
    for view in views:
        first = found.setdefault(_clean_path(view), view)
        if not (np.allclose(first.R, view.R, atol=_SAME) and np.allclose(first.center, view.center, _SAME, _SAME)):
            raise UserError(f"{listed_by} lists the photo {_clean_path(view)} twice, with different poses; keep one")
    if len(found) < len(views):
        print(f"{len(views) - len(found)} frames of {listed_by} repeat a photo and are left out", file=sys.stderr)
    return list(found.values())


def _clean_path(view: CameraInfo) -> str:
    return os.path.normpath(view.lying or view.image_path)


def _find_ply(folder: Path) -> Path | None:
    """points3d.ply of a folder, in letters of any case."""
    return max((path for path in folder.iterdir() if path.name.lower() == "points3d.ply"), default=None)


def read_nerfstudio(
    folder: Path,
    images: str,
    hold_out: bool,
    start: StartOptions | None = OWN_POINTS,
    masks: MaskOptions = NO_MASKS,
    native: bool = False,
    rule: str = EVERY,
) -> SceneInfo:
    """Read a nerfstudio or instant-ngp scene (transforms.json), or what stands for it (`camera_file`), views sorted by
    name (bytes).

    hold_out: the file's own split if it has one (test_frames, and test_filenames, else val_filenames, are the test
    views), else as `rule` says. Frames may name masks, which --masks replaces. Points come from the file's
    ply_file_path, else from a points3D.ply beside it. Arguments and errors as for `scene.dataset_readers.read_scene`.
    """
    path = camera_file(folder) or folder / "transforms.json"
    content = _read_frame_list(path, partial(_read_content, images=images))
    read = partial(_make_cameras, path, masks=masks, suffixes=SUFFIXES, images=images, by_stem=False, native=native)
    try:
        cameras = read(content)
    except UserError as error:
        if hold_out or not content["test_frames"]:
            raise
        content = {**content, "frames": content["frames"][: -len(content["test_frames"])], "test_frames": []}
        cameras = read(content)
        print(f"the test_frames of {path} are not used for training: {error}", file=sys.stderr)
    tests = {_clean_path(view) for view in cameras[len(cameras) - len(content["test_frames"]) :]}
    cameras = _dedupe(cameras, str(path))
    cameras.sort(key=lambda camera: os.fsencode(camera.image_name))
    if not cameras:
        raise UserError(f"{path} lists no frames; export the scene again")
    if views := _read_own_split(path, content, cameras, tests, hold_out):
        refuse_rule(rule, path)
    else:
        views = split(cameras, hold_out, rule, folder)

    def own() -> StartCloud | None:
        name = content.get("ply_file_path")
        ply = (FileIndex(folder).find(str(name)) or folder / str(name)) if name else _find_ply(folder)
        return StartCloud(read_point_cloud(ply), ply) if ply else None

    nothing = "names no points (ply_file_path)" if path.name == "transforms.json" else "is an export without points"
    lacking = f"{path} {nothing}, and no points3D.ply lies beside it"
    return scene_info(views, start, own, lambda: random_in_frusta(views[0]), lacking)


def _read_content(path: Path, images: str) -> dict[str, Any]:
    """Read the content of a camera file, or convert another program's export into it."""
    if path.is_dir():
        return read_polycam(path)
    if path.suffix.lower() == ".xml":
        return read_metashape(path, images)
    return read_json(path) if path.name == "transforms.json" else read_record3d(path)


def _read_frame_list(path: Path, load: Callable[[Path], Any] = read_json) -> dict[str, Any]:
    """A camera file's content, with a list of frames that have a file_path and a transform_matrix.

    Those of test_frames are the last of them. A message names fields that are not used and may change the result.
    """
    try:
        content = load(path)
        frames = list(content["frames"])
        content["test_frames"] = list(content.get("test_frames") or ())
        content["frames"] = frames + content["test_frames"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _make_content_error(path, error) from error
    for number, frame in enumerate(content["frames"], start=1):
        lacking = [key for key in ("file_path", "transform_matrix") if not isinstance(frame, dict) or key not in frame]
        if lacking:
            fault = f"has no {' and no '.join(lacking)}; fix the frame, or take it out"
            raise UserError(f"{_name_frame(path, number, frame)} {fault}")
    for part in (content, *content["frames"]):
        for key in part:
            if key.endswith("_path") and isinstance(part[key], str):
                part[key] = part[key].translate(_ESCAPED)
    _say_what_is_unused(path, content)
    return content


def _say_what_is_unused(path: Path, content: dict[str, Any]) -> None:
    """Note the entries of a transforms file that are set and that nothing here reads."""
    frames = content["frames"]
    told = {name for frame in frames for name, value in frame.items() if name not in _READ and _is_set(value)}
    if len({str(frame.get("time")) for frame in frames}) < 2:
        told.discard("time")  # the photos are of one moment
    note_unread(path, "transforms", {name for name, value in content.items() if name not in _READ and _is_set(value)})
    note_unread(path, "frames", told)


def _is_set(value: Any) -> bool:
    """Tell whether a value, or one in its lists, is not zero, false or empty."""
    return bool(np.any(np.array(value, dtype=object)))


def _name_frame(path: Path, number: int, frame: Any) -> str:
    name = f" ({frame['file_path']})" if isinstance(frame, dict) and "file_path" in frame else ""
    return f"frame {number}{name:.80} of {path}"


def _make_content_error(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is not a camera file ({type(error).__name__}: {error}); it needs camera_angle_x or fl_x, and frames, "
        "each with file_path and a 4x4 transform_matrix"
    )


def _make_cameras(
    path: Path,
    content: dict[str, Any],
    masks: MaskOptions,
    suffixes: Sequence[str],
    images: str,
    by_stem: bool,
    native: bool = False,
) -> list[CameraInfo]:
    """The views in the order of the frames, named by the stems or by the relative paths of their files."""
    frames = content["frames"]
    poses = [_read_pose(path, number, frame) for number, frame in enumerate(frames, start=1)]
    listed = [str(frame["file_path"]) for frame in frames]
    remedy = f"put them there, or take their frames out of {path.name} to go on without"
    if place := other_folder(path, listed, images, suffixes):
        photos = find_in(place, listed, suffixes)
    else:
        photos = find_images(path.parent, listed, str(path), remedy, suffixes)
    names = [os.path.relpath(photo, path.parent) for photo in photos]
    found = _find_frame_masks(path, frames, names, photos, masks)
    sizes, cameras = picture_sizes(photos), []
    for index, (frame, photo, mask, (R, T)) in enumerate(zip(frames, photos, found, poses, strict=True)):
        lens = _read_lens(path, content, frame, sizes[index])
        if circle := circle_of(frame, content, lens.width, path):
            mask = replace(mask or Mask(photo, drawn=False), circle=circle)
        name = photo.stem if by_stem else names[index]
        cameras.append(camera_info(index, name, photo, lens, R, T, mask, masks.ignore_alpha, native))
    return to_pinholes(cameras, masks.drop_alpha)


def _read_lens(path: Path, content: dict[str, Any], frame: dict[str, Any], size: tuple[int, int]) -> Lens:
    try:
        return lens_of(frame, content, size, path)
    except (ValueError, TypeError, OverflowError) as error:
        raise _make_content_error(path, error) from error


def _read_pose(path: Path, number: int, frame: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world rotation (3,3) and world-to-camera translation (3,), y down and z forward.

    The file has an OpenGL camera-to-world matrix (y up, z backward).
    """
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"transform_matrix must be 4x4 finite numbers, got shape {matrix.shape}")
        matrix[:3, 1:3] *= -1
        inverse = np.linalg.inv(matrix)
        if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-3:
            raise ValueError(f"the last row of transform_matrix must be 0 0 0 1, got {matrix[3]}")
    except (ValueError, TypeError, OverflowError, np.linalg.LinAlgError) as error:
        raise UserError(
            f"{_name_frame(path, number, frame)} has no usable pose ({type(error).__name__}: {error}); it needs a "
            "transform_matrix of 4x4 finite numbers that can be inverted"
        ) from error
    return inverse[:3, :3].T.copy(), inverse[:3, 3].copy()


def _find_frame_masks(
    path: Path, frames: list[dict[str, Any]], names: list[str], photos: list[Path], masks: MaskOptions
) -> list[Mask | None]:
    """Find the mask of each frame, None without one: as `mask_path` names it, or by the options' folder."""
    listed = [frame.get("mask_path") for frame in frames]
    if masks.folder or not any(listed):
        return find_masks(path.parent, names, masks, photos)
    named = [str(name) for name in listed if name]
    remedy = f"put them there, or take mask_path out of {path.name} to go on without"
    paths = iter(find_images(path.parent, named, str(path), remedy, kind="masks"))
    found = [masks.mask(next(paths)) if name else None for name in listed]
    for number, (photo, mask) in enumerate(zip(photos, found, strict=True), start=1):
        if mask and mask.path.samefile(photo):
            fault = "names the photo itself as its mask (mask_path)"
            remedy = "name a mask file, or take mask_path out and use alpha channels by --mask_meaning ignore"
            raise UserError(f"{_name_frame(path, number, frames[number - 1])} {fault}; {remedy}")
    return found


def _read_own_split(
    path: Path, content: dict[str, Any], cameras: list[CameraInfo], tests: set[str], hold_out: bool
) -> tuple[list[CameraInfo], list[CameraInfo]] | None:
    """Training and test views by the file's lists, and by the photos of its test_frames; None without any of them, or
    without hold_out.
    """
    if not hold_out:
        return None
    lists, index = [], FileIndex(path.parent)
    place = path.parent / os.path.commonpath([os.path.dirname(camera.image_name) for camera in cameras])
    for name in SPLITS:
        listed = content.get(name) or []
        if not isinstance(listed, list):
            raise UserError(f"{name} in {path} must be a list of file names; fix it, or leave it out")
        names = [str(entry).translate(_ESCAPED) for entry in listed]
        found = zip(find_listed(index, names, SUFFIXES)[0], find_in(place, names, SUFFIXES), strict=True)
        lists.append(dict(zip(names, (own or elsewhere for own, elsewhere in found), strict=True)))
    if not (any(lists[1:]) or tests):
        return None
    photos = [identity(path.parent / camera.image_name) for camera in cameras]
    of_frames = set(photos)
    without = [name for files in lists for name, file in files.items() if identity(file) not in of_frames]
    if without:
        said = f"{len(without)} entries of the lists of training and test photos in {path} match no photo of its frames"
        print(f"{said}: {some(without)}", file=sys.stderr)
    trained, tested = ({identity(file) for file in files.values()} for files in (lists[0], lists[2] or lists[1]))
    test, train, left = [], [], []
    for camera, photo in zip(cameras, photos, strict=True):
        is_test = photo in tested or _clean_path(camera) in tests
        (test if is_test else train if photo in trained or not lists[0] else left).append(camera)
    if not test or not train:
        raise UserError(
            f"of the photos in {path}, {len(train)} are in train_filenames and {len(test)} in test_filenames (or "
            "val_filenames, or test_frames), but each list needs at least one; fix the lists or leave --eval out"
        )
    if left:
        names = some([camera.image_name for camera in left])
        print(
            f"{len(left)} photos of {path} are in no list for training or tests and are left out: {names}",
            file=sys.stderr,
        )
    return train, held_out(test)
