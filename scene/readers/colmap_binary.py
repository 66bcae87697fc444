"""Single binary files of a COLMAP model, as records, and its dense maps.

A missing file is a FileNotFoundError, so that a caller can try the text file; a broken one is a UserError.
"""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from scene.readers.colmap_records import CAMERA_MODEL_IDS, Camera, Image, Points, points_of
from utils.system_utils import UserError

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT = struct.Struct("<Q3d3BdQ")
_POINT_2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("id", "<i8")])
_Record = TypeVar("_Record")


def read_intrinsics_binary(path: str | os.PathLike) -> dict[int, Camera]:
    """Cameras of a cameras.bin by their ids."""
    return {camera.id: camera for camera in _binary_records(Path(path), "camera", _camera)}


def read_extrinsics_binary(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.bin by their ids."""
    return {image.id: image for image in _binary_records(Path(path), "photo", _image)}


def read_points3D_binary(path: str | os.PathLike) -> Points:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.bin in its order, all float64."""
    return points_of([values for _, *values in read_point_rows_binary(path)])


def read_point_rows_binary(path: str | os.PathLike) -> list[tuple]:
    """Id, position, colour and error of each point of a points3D.bin, in its order."""
    return list(_binary_records(Path(path), "point", _point))


def read_colmap_bin_array(path: str | os.PathLike) -> np.ndarray:
    """Dense map of COLMAP, (height, width) or (height, width, channels) float32: depths, or normals.

    The file begins with `width&height&channels&`; its values follow with the column running fastest.
    """
    content = Path(path).read_bytes()
    try:
        *sizes, values = content.split(b"&", maxsplit=3)
        shape = tuple(int(size) for size in sizes)
        if len(shape) != 3 or len(values) != 4 * np.prod(shape):
            raise ValueError(f"sizes {shape}, {len(values)} bytes of values")
    except ValueError as error:
        raise UserError(f"{path} is not a whole map of COLMAP ({error}); copy the file again") from error
    array = np.frombuffer(values, "<f4").reshape(shape, order="F").transpose(1, 0, 2)
    return array.squeeze().copy()


def read_next_bytes(
    fid: BinaryIO, num_bytes: int, format_char_sequence: str, endian_character: str = "<"
) -> tuple[int | float | bytes, ...]:
    """The next values of an open binary file, by the formats of `struct`."""
    return struct.unpack(endian_character + format_char_sequence, fid.read(num_bytes))


class _Bytes:
    """A file's content, read from its start. ValueError or struct.error where it is too short."""

    def __init__(self, path: Path) -> None:
        self._content = path.read_bytes()
        self._at = 0

    def take(self, layout: struct.Struct) -> tuple:
        values = layout.unpack_from(self._content, self._at)
        self._at += layout.size
        return values

    def array(self, kind: np.dtype | str, count: int) -> np.ndarray:
        if count == 0:  # which frombuffer refuses at the end of a file
            return np.zeros(0, kind)
        values = np.frombuffer(self._content, kind, count, self._at)
        self._at += values.nbytes
        return values.copy()

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._content):
            raise ValueError("too short")

    def text(self) -> str:
        end = self._content.index(b"\0", self._at)
        text = self._content[self._at : end].decode("utf-8")
        self._at = end + 1
        return text


def _binary_records(path: Path, what: str, read: Callable[[_Bytes], _Record]) -> Iterator[_Record]:
    content, count, number = _Bytes(path), 1, 1
    try:
        (count,) = content.take(_COUNT)
        while number <= count:
            yield read(content)
            number += 1
    except UnicodeDecodeError as error:
        raise UserError(f"the name of {what} {number} in {path} is not UTF-8; rename it in plain letters") from error
    except (struct.error, ValueError, OverflowError) as error:
        raise UserError(
            f"{path} ends within {what} {number} of {count}, or is no such file; copy it again from where it was made"
        ) from error
    except KeyError as error:
        raise UserError(
            f"{what} {number} in {path} has the unknown camera model {error}; convert the model with a COLMAP that "
            "knows it"
        ) from error


def _camera(content: _Bytes) -> Camera:
    id, model_id, width, height = content.take(_CAMERA)
    model = CAMERA_MODEL_IDS[model_id]
    return Camera(id, model.model_name, width, height, content.array("<f8", model.num_params))


def _image(content: _Bytes) -> Image:
    id, *pose, camera_id = content.take(_IMAGE)
    name = content.text()
    points = content.array(_POINT_2D, content.take(_COUNT)[0])
    xys = np.column_stack([points["x"], points["y"]])
    return Image(id, np.array(pose[:4]), np.array(pose[4:]), camera_id, name, xys, points["id"].copy())


def _point(content: _Bytes) -> tuple:
    *values, seen = content.take(_POINT)
    content.skip(8 * seen)
    return tuple(values)
