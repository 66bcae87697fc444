"""Single text files of a COLMAP model, as records.

A missing file is a FileNotFoundError; a broken one is a UserError.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scene.readers.colmap_records import CAMERA_MODEL_NAMES, Camera, Image, Points, points_of
from utils.system_utils import UserError


def read_intrinsics_text(path: str | os.PathLike) -> dict[int, Camera]:
    """Cameras of a cameras.txt by their ids."""
    cameras = {}
    for number, line in _data_lines(Path(path)):
        try:
            id, model, width, height, *params = line.split()
            camera = Camera(int(id), model, int(width), int(height), np.array(params, dtype=np.float64))
            if model not in CAMERA_MODEL_NAMES or len(params) != CAMERA_MODEL_NAMES[model].num_params:
                raise ValueError(f"{model} with {len(params)} parameters")
        except ValueError as error:
            raise _bad_line(path, number, "id, camera model, width, height and its parameters", error) from error
        cameras[camera.id] = camera
    return cameras


def read_extrinsics_text(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.txt by their ids. A name may have spaces, and the line of 2D points may be empty."""
    images = {}
    lines = _data_lines(Path(path), keep_next=True)
    for number, line in lines:
        try:
            words = line.split(maxsplit=9)
            id, pose, camera_id, name = int(words[0]), np.array(words[1:8], dtype=np.float64), words[8], words[9]
            qvec, tvec, camera_id = pose[:4], pose[4:], int(camera_id)
            number, line = next(lines, (number, ""))
            points = np.array(line.split(), dtype=np.float64).reshape(-1, 3)
            # Not from the floats, which hold ids to 2^53 only.
            ids = np.array(line.split()[2::3], dtype=np.int64)
        except (ValueError, IndexError, OverflowError) as error:
            wanted = "a photo's id, rotation, translation, camera id, name, or in the line after it x, y, id of points"
            raise _bad_line(path, number, wanted, error) from error
        images[id] = Image(id, qvec, tvec, camera_id, name, points[:, :2].copy(), ids)
    return images


def read_points3D_text(path: str | os.PathLike) -> Points:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.txt in its order, all float64."""
    return points_of([values for _, *values in read_point_rows_text(path)])


def read_point_rows_text(path: str | os.PathLike) -> list[tuple]:
    """Id, position, colour and error of each point of a points3D.txt, in its order."""
    rows = []
    for number, line in _data_lines(Path(path)):
        try:
            id, *values = line.split(maxsplit=8)[:8]
            x, y, z, red, green, blue, error = map(float, values)
            rows.append((int(id), x, y, z, red, green, blue, error))
        except ValueError as fault:
            raise _bad_line(path, number, "id, position, colour and error of a point", fault) from fault
    return rows


def _data_lines(path: Path, keep_next: bool = False) -> Iterator[tuple[int, str]]:
    """Number (from 1) and text of the lines that are neither empty nor comments.

    keep_next: and of each line that follows one of these, whatever it is.
    """
    with open(path, encoding="utf-8") as file:
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
    return UserError(f"line {number} of {path} does not list {wanted} ({error}); fix it, or copy the file again")
