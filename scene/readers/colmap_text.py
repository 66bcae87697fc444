"""Single text files of a COLMAP model, as records.

A missing file is a FileNotFoundError; a broken one is a UserError.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scene.readers.colmap_records import CAMERA_MODEL_NAMES, Camera, Image, Points, PointTable
from splatting.files.file_kinds import not_the_file
from utils.system_utils import UserError, first_line


def read_intrinsics_text(path: str | os.PathLike) -> dict[int, Camera]:
    """Cameras of a cameras.txt by their ids."""
    cameras = {}
    for number, line in _data_lines(Path(path)):
        try:
            id, model, width, height, *params = line.split()
            camera = Camera(int(id), model, int(width), int(height), np.array(params, dtype=np.float64))
            if model not in CAMERA_MODEL_NAMES:
                raise ValueError(f"COLMAP has no camera model {model}")
            if len(params) != CAMERA_MODEL_NAMES[model].num_params:
                raise ValueError(f"{model} with {len(params)} parameters")
        except ValueError as error:
            raise _bad_line(path, number, "id, camera model, width, height and its parameters", error) from error
        cameras[camera.id] = camera
    return cameras


def read_extrinsics_text(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.txt by their ids. A name may have spaces, and the line of 2D points may be empty."""
    return _images(Path(path), with_points=True)


def read_poses_text(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.txt by their ids, without their 2D points."""
    return _images(Path(path), with_points=False)


def _images(path: Path, with_points: bool) -> dict[int, Image]:
    images = {}
    lines = _data_lines(path, keep_next=True)
    for number, line in lines:
        try:
            words = line.split(maxsplit=9)
            id, pose, camera_id, name = int(words[0]), np.array(words[1:8], dtype=np.float64), words[8], words[9]
            qvec, tvec, camera_id = pose[:4], pose[4:], int(camera_id)
            number, line = next(lines, (number, ""))
            words = line.split()
            if not with_points:  # a line that was left out would make the next photo one of points
                words = [*words[:3], *words[-3:]] if len(words) % 3 == 0 else words
            points = np.array(words, dtype=np.float64).reshape(-1, 3)
            # Not from the floats, which hold ids to 2^53 only.
            ids = np.array(words[2::3], dtype=np.int64)
            if not with_points:
                points, ids = points[:0], ids[:0]
        except (ValueError, IndexError, OverflowError) as error:
            wanted = "a photo's id, rotation, translation, camera id, name, or in the line after it x, y, id of points"
            raise _bad_line(path, number, wanted, error) from error
        images[id] = Image(id, qvec, tvec, camera_id, name, points[:, :2].copy(), ids)
    return images


def read_points3D_text(path: str | os.PathLike) -> Points:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.txt in its order, all float64."""
    return read_point_table_text(path).published()


def read_point_table_text(path: str | os.PathLike) -> PointTable:
    """Points of a points3D.txt."""
    ids, rows = [], []
    for number, line in _data_lines(Path(path)):
        try:
            id, *values = line.split(maxsplit=8)[:8]
            x, y, z, red, green, blue, error = map(float, values)
            if not (math.isfinite(x + y + z) and 0 <= red <= 255 and 0 <= green <= 255 and 0 <= blue <= 255):
                raise ValueError(f"got {' '.join(values)}")
            ids.append(int(id))
            if ids[-1] >> 63:
                raise ValueError(f"id {id}")
        except ValueError as fault:
            wanted = "id, finite position, colour up to 255 and error of a point"
            raise _bad_line(path, number, wanted, fault) from fault
        rows.append((x, y, z, red, green, blue, error))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return PointTable(np.array(ids, dtype=np.int64), table[:, :3], table[:, 3:6], table[:, 6])


def _data_lines(path: Path, keep_next: bool = False) -> Iterator[tuple[int, str]]:
    """Number (from 1) and text of the lines that are neither empty nor comments.

    keep_next: and of each line that follows one of these, whatever it is.
    """
    with open(path, encoding="utf-8-sig") as file:
        lines = enumerate(file, start=1)
        try:
            for number, line in lines:
                if line.strip() and not line.startswith("#"):
                    yield number, line.strip()
                    if keep_next:
                        number, line = next(lines, (number, ""))
                        yield number, line.strip()
        except UnicodeDecodeError as error:
            raise UserError(f"{path} is not UTF-8 text; rename its photos in plain letters") from error


def _bad_line(path: str | os.PathLike, number: int, wanted: str, error: Exception) -> UserError:
    if other := not_the_file(path):
        return UserError(f"{path} is {other}; copy the file again from where it was made")
    said = first_line(error)
    return UserError(f"line {number} of {path} does not list {wanted} ({said}); fix it, or copy the file again")
