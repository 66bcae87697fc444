"""Captures of the phone apps Polycam and Record3D, as the content of a transforms.json.

Both have ARKit's poses, whose axes are those of transforms.json: x right, y up, z backward, camera to world, in metres.
Layouts: https://github.com/PolyCam/polyform, and issues 7, 27, 33 and 83 of https://github.com/marek-simonik/record3d.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.image_files import SUFFIXES
from groundwork.files.json_files import read_json
from scene.colmap_loader import qvec2rotmat
from utils.system_utils import UserError

# Photos and cameras of Polycam: corrected ones are undistorted, and their poses optimized over the whole capture.
_POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
_NAMES = (("fl_x", "fx"), ("fl_y", "fy"), ("cx", "cx"), ("cy", "cy"), ("w", "width"), ("h", "height"))
_RECORD3D = (("metadata.json", "rgb"), ("metadata", "rgbd"))  # of its export EXR + JPG, and of an unpacked .r3d


def polycam_capture(folder: Path) -> Path | None:
    """The folder keyframes of a Polycam capture; None where there is none."""
    keyframes = folder / "keyframes"
    return keyframes if any((keyframes / cameras).is_dir() for _, cameras in _POLYCAM) else None


def record3d_capture(folder: Path) -> Path | None:
    """The metadata of a Record3D capture; None where there are none."""
    found = (folder / name for name, photos in _RECORD3D if (folder / photos).is_dir())
    return next((path for path in found if path.is_file()), None)


def read_polycam(keyframes: Path) -> dict[str, Any]:
    """The content of a transforms.json for the folder keyframes of a capture. UserError for a broken file.

    A message says which photos are left out, and that poses are not optimized where that is so.
    """
    pairs = [pair for pair in _POLYCAM if all((keyframes / name).is_dir() for name in pair)]
    if not pairs:
        raise UserError(f"{keyframes} has cameras but no photos; export the raw data of the capture again")
    images, cameras = pairs[0]
    if images == "images":
        print(
            f"{keyframes} has no corrected_cameras: photos are distorted and poses drift; to get them, process the "
            "capture again with Loop Closure in Polycam, and export its raw data",
            file=sys.stderr,
        )
    photos = {path.stem: path for path in sorted((keyframes / images).iterdir()) if _is_photo(path)}
    files = {path.stem: path for path in sorted((keyframes / cameras).glob("*.json"))}
    _say_left_out(len(photos.keys() ^ files.keys()), f"{keyframes / images} and {keyframes / cameras}")
    frames = []
    for name in sorted(photos.keys() & files.keys()):
        with _explain_faults(files[name]):
            camera = read_json(files[name])
            pose = np.eye(4)
            pose[:3] = [[float(camera[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            lens = {ours: float(camera[theirs]) for ours, theirs in _NAMES}
        frames.append(
            {"file_path": _name_below(keyframes.parent, photos[name]), "transform_matrix": pose.tolist(), **lens}
        )
    return {"frames": frames}


def read_record3d(metadata: Path) -> dict[str, Any]:
    """The content of a transforms.json for the metadata of a capture. UserError for a broken file.

    The number in a photo's name is that of its pose. A message says how many photos have none, and the other way round.
    """
    folder = metadata.parent / dict(_RECORD3D)[metadata.name]
    numbered = {int(path.stem): path for path in folder.iterdir() if path.stem.isdecimal() and _is_photo(path)}
    with _explain_faults(metadata):
        content = read_json(metadata)
        poses = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        fx, fy, cx, cy = np.array(content["K"], dtype=np.float64).reshape(9)[[0, 4, 6, 7]]  # by columns
        lenses = np.array(content.get("perFrameIntrinsicCoeffs") or [(fx, fy, cx, cy)] * len(poses), dtype=np.float64)
        if lenses.shape != (len(poses), 4):
            raise ValueError(f"{len(poses)} poses, and perFrameIntrinsicCoeffs of the shape {lenses.shape}")
        size = {"w": float(content["w"]), "h": float(content["h"])}
    _say_left_out(len(numbered.keys() ^ set(range(len(poses)))), f"{folder} and the poses of {metadata}")
    frames = []
    for number in sorted(number for number in numbered if number < len(poses)):
        x, y, z, w, *center = poses[number]
        pose = np.eye(4)
        pose[:3] = np.column_stack([qvec2rotmat(np.array([w, x, y, z])), center])
        lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), lenses[number].tolist(), strict=True))
        frames.append(
            {"file_path": _name_below(metadata.parent, numbered[number]), "transform_matrix": pose.tolist(), **lens}
        )
    return {"frames": frames, **size}


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES


def _name_below(folder: Path, photo: Path) -> str:
    return photo.relative_to(folder).as_posix()


def _say_left_out(count: int, where: str) -> None:
    """Say how many photos or cameras of `where` lack a counterpart, if any."""
    if count:
        print(
            f"{count} photos or cameras of {where} have no counterpart of the same name and are ignored",
            file=sys.stderr,
        )


@contextmanager
def _explain_faults(path: Path) -> Iterator[None]:
    """Raise a UserError in place of errors while the camera file of an export is read."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise UserError(
            f"{path} is not a camera file of an export ({type(error).__name__}: {error}); export the capture again"
        ) from error
