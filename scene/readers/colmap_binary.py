"""Single binary files of a COLMAP model, as records, and its dense maps.

A missing file is a FileNotFoundError, so that a caller can try the text file; a broken one is a UserError.
"""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from scene.readers.colmap_records import CAMERA_MODEL_IDS, Camera, Image, Points, PointTable
from splatting.files.file_kinds import not_the_file
from utils.system_utils import UserError

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("seen", "<u8")])
_SEEN = _POINT.fields["seen"][1]  # its place in the record
_TRACK = 8  # bytes for each photo that sees a point
_POINT_2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("id", "<i8")])
_Record = TypeVar("_Record")


def read_intrinsics_binary(path: str | os.PathLike) -> dict[int, Camera]:
    """Cameras of a cameras.bin by their ids."""
    return {camera.id: camera for camera in _binary_records(Path(path), "camera", _camera)}


def read_extrinsics_binary(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.bin by their ids."""
    return {image.id: image for image in _binary_records(Path(path), "photo", _image)}


def read_poses_binary(path: str | os.PathLike) -> dict[int, Image]:
    """Photos of an images.bin by their ids, without their 2D points."""
    return {image.id: image for image in _binary_records(Path(path), "photo", _pose)}


def read_points3D_binary(path: str | os.PathLike) -> Points:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.bin in its order, all float64."""
    return read_point_table_binary(path).published()


def read_point_table_binary(path: str | os.PathLike) -> PointTable:
    """Points of a points3D.bin."""
    content, count, at, starts = Path(path).read_bytes(), 1, _COUNT.size, []
    try:
        (count,) = _COUNT.unpack_from(content)
        while len(starts) < count:
            (seen,) = _COUNT.unpack_from(content, at + _SEEN)
            starts.append(at)
            at += _POINT.itemsize + _TRACK * seen
        if at > len(content):
            raise struct.error
    except (struct.error, OverflowError) as error:
        whole = len(starts) - (at > len(content))
        raise _cut_short(path, "point", whole + 1, count) from error
    # A view has a record at every byte of the file; those at the starts are real.
    places = len(content) - _POINT.itemsize + 1
    rows = np.ndarray((places,), _POINT, content, strides=(1,))[starts] if starts else np.zeros(0, _POINT)
    return PointTable(rows["id"], rows["xyz"], rows["rgb"], rows["error"])


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
        raise _cut_short(path, what, number, count) from error
    except KeyError as error:
        raise UserError(
            f"{what} {number} in {path} has the unknown camera model {error}; convert the model with a COLMAP that "
            "knows it"
        ) from error


def _cut_short(path: str | os.PathLike, what: str, number: int, count: int) -> UserError:
    fault = not_the_file(path)
    fault = f"is {fault}" if fault else f"ends within {what} {number:,} of {count:,}, or is no such file"
    return UserError(f"{path} {fault}; copy the file again from where it was made")


def _camera(content: _Bytes) -> Camera:
    id, model_id, width, height = content.take(_CAMERA)
    model = CAMERA_MODEL_IDS[model_id]
    return Camera(id, model.model_name, width, height, content.array("<f8", model.num_params))


def _image(content: _Bytes) -> Image:
    image = _head(content)
    points = content.array(_POINT_2D, content.take(_COUNT)[0])
    xys = np.column_stack([points["x"], points["y"]])
    return image._replace(xys=xys, point3D_ids=points["id"].copy())


def _pose(content: _Bytes) -> Image:
    image = _head(content)
    content.skip(_POINT_2D.itemsize * content.take(_COUNT)[0])
    return image


def _head(content: _Bytes) -> Image:
    id, *pose, camera_id = content.take(_IMAGE)
    name = content.text()
    return Image(id, np.array(pose[:4]), np.array(pose[4:]), camera_id, name, np.zeros((0, 2)), np.zeros(0, np.int64))
