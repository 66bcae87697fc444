"""COLMAP's files, each as records with COLMAP's own names, by the names and arguments of the reference.

Binary and text files give the same values in the same order, so that one parser makes the records of both. A missing
file is a FileNotFoundError, so that a caller can try the other kind; a broken one is a UserError.
"""

import functools
import math
import os
import struct
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np

from groundwork.files.plain_files import describe_wrong_file, encoding_of
from utils.system_utils import UserError, first_line

StrPath = str | os.PathLike
Record = TypeVar("Record")

_ROW = np.dtype([("ids", "i8"), ("xyz", "f8", 3), ("rgb", "f8", 3), ("errors", "f8")])  # as Points, in a text file
_ROUNDED = 1e-12  # departure of a quaternion's length from 1 that double precision leaves


class CameraModel(NamedTuple):
    """COLMAP's number and name of a camera model, and its number of parameters."""

    model_id: int
    model_name: str
    num_params: int


CAMERA_MODELS = {
    CameraModel(0, "SIMPLE_PINHOLE", 3),
    CameraModel(1, "PINHOLE", 4),
    CameraModel(2, "SIMPLE_RADIAL", 4),
    CameraModel(3, "RADIAL", 5),
    CameraModel(4, "OPENCV", 8),
    CameraModel(5, "OPENCV_FISHEYE", 8),
    CameraModel(6, "FULL_OPENCV", 12),
    CameraModel(7, "FOV", 5),
    CameraModel(8, "SIMPLE_RADIAL_FISHEYE", 4),
    CameraModel(9, "RADIAL_FISHEYE", 5),
    CameraModel(10, "THIN_PRISM_FISHEYE", 12),
    CameraModel(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    CameraModel(12, "SIMPLE_DIVISION", 4),
    CameraModel(13, "DIVISION", 5),
    CameraModel(14, "SIMPLE_FISHEYE", 3),
    CameraModel(15, "FISHEYE", 4),
    CameraModel(16, "EUCM", 6),
    CameraModel(17, "EQUIRECTANGULAR", 2),
}
CAMERA_MODEL_IDS = {model.model_id: model for model in CAMERA_MODELS}
CAMERA_MODEL_NAMES = {model.model_name: model for model in CAMERA_MODELS}


class Camera(NamedTuple):
    """Intrinsics: the camera model by name, width and height in pixels, params (n,) float64 in COLMAP's order."""

    id: int
    model: str
    width: int
    height: int
    params: np.ndarray


class BaseImage(NamedTuple):
    """A photo: world-to-camera qvec (4,) w x y z and tvec (3,), name, 2D points xys (n,2), point3D_ids (n,)."""

    id: int
    qvec: np.ndarray
    tvec: np.ndarray
    camera_id: int
    name: str
    xys: np.ndarray
    point3D_ids: np.ndarray


class Image(BaseImage):
    """A photo that knows its rotation as a matrix."""

    def qvec2rotmat(self) -> np.ndarray:
        """World-to-camera rotation (3,3)."""
        return qvec2rotmat(self.qvec)


class Point3D(NamedTuple):
    """A point: xyz (3,), rgb (3,) to 255, its error in pixels, and the photos and 2D points that see it, (n,) each."""

    id: int
    xyz: np.ndarray
    rgb: np.ndarray
    error: float
    image_ids: np.ndarray
    point2D_idxs: np.ndarray


class Points(NamedTuple):
    """Points in the order of their file: ids (N,) int64, xyz (N,3), rgb (N,3) to 255, errors (N,) in pixels."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    errors: np.ndarray


def qvec2rotmat(qvec: np.ndarray) -> np.ndarray:
    """Rotation (3,3) of a quaternion w x y z of any length; NaN for one of zeros. Rounded as COLMAP's own is."""
    w, x, y, z = map(float, qvec)
    length = math.hypot(w, x, y, z)
    if not abs(length - 1) <= _ROUNDED:
        w, x, y, z = (value / length if length else math.nan for value in (w, x, y, z))
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    xx, yy, zz = x2 * x, y2 * y, z2 * z
    return np.array(
        [
            [1 - (yy + zz), y2 * x - z2 * w, z2 * x + y2 * w],
            [y2 * x + z2 * w, 1 - (xx + zz), z2 * y - x2 * w],
            [z2 * x - y2 * w, z2 * y + x2 * w, 1 - (xx + yy)],
        ]
    )


def rotmat2qvec(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) w x y z, w >= 0, of a rotation (3,3); the nearest one if the matrix is not quite a rotation.

    Source: I. Y. Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    R = np.asarray(R, dtype=np.float64)
    trace = np.trace(R)
    # Rows and columns are x y z w. The quaternion is the eigenvector of the largest eigenvalue.
    matrix = np.empty((4, 4))
    matrix[:3, :3] = R + R.T - trace * np.eye(3)
    matrix[:3, 3] = matrix[3, :3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    matrix[3, 3] = trace
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    return np.array([w, x, y, z]) * (-1 if w < 0 else 1)


def read_intrinsics_binary(path_to_model_file: StrPath) -> dict[int, Camera]:
    """Cameras of a cameras.bin by their ids."""
    return read_cameras(path_to_model_file, binary=True)


def read_intrinsics_text(path: StrPath) -> dict[int, Camera]:
    """Cameras of a cameras.txt by their ids."""
    return read_cameras(path, binary=False)


def read_extrinsics_binary(path_to_model_file: StrPath) -> dict[int, Image]:
    """Photos of an images.bin by their ids."""
    return read_images(path_to_model_file, binary=True)


def read_extrinsics_text(path: StrPath) -> dict[int, Image]:
    """Photos of an images.txt by their ids. A name may have spaces, and the line of 2D points may be empty."""
    return read_images(path, binary=False)


def read_points3D_binary(path_to_model_file: StrPath) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.bin in its order, all float64."""
    _, xyz, rgb, errors = read_points(path_to_model_file, binary=True)
    return xyz.copy(), rgb.astype(np.float64), errors[:, None].copy()


def read_points3D_text(path: StrPath) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (N,3), colours (N,3) to 255 and errors (N,1) of a points3D.txt in its order, all float64."""
    _, xyz, rgb, errors = read_points(path, binary=False)
    return xyz.copy(), rgb.copy(), errors[:, None].copy()


def read_colmap_bin_array(path: StrPath) -> np.ndarray:
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
        raise UserError(f"{path} is not a complete dense map of COLMAP ({error}); copy the file again") from error
    array = np.frombuffer(values, "<f4").reshape(shape, order="F").transpose(1, 0, 2)
    return array.squeeze().copy()


def read_next_bytes(
    fid: BinaryIO, num_bytes: int, format_char_sequence: str, endian_character: str = "<"
) -> tuple[int | float | bytes, ...]:
    """The next values of an open binary file, by the formats of `struct`."""
    return struct.unpack(endian_character + format_char_sequence, fid.read(num_bytes))


def read_cameras(path: StrPath, binary: bool) -> dict[int, Camera]:
    """Cameras of a cameras file by their ids."""
    return _collect_by_id(_open_file(path, binary), "camera", _read_camera)


def read_images(path: StrPath, binary: bool, with_points: bool = True) -> dict[int, Image]:
    """Photos of an images file by their ids. with_points: and their 2D points, which take time and memory."""
    return _collect_by_id(_open_file(path, binary), "photo", lambda file: _read_image(file, with_points))


def read_points(path: StrPath, binary: bool) -> Points:
    """Points of a points3D file. UserError where two have one id, or where colours of a text range to 1."""
    file = _open_file(path, binary)
    points = file.points()
    order = np.argsort(points.ids, kind="stable")
    again = np.flatnonzero(np.diff(points.ids[order]) == 0)
    if len(again):
        first, second = (file.place_of(place) for place in sorted(order[again[0] : again[0] + 2]))
        raise _make_twice_error(file, first, second, f"the id {points.ids[order[again[0]]]}")
    part = (points.rgb % 1).any(axis=1)
    if part.any() and points.rgb.max() <= 1:
        first = part.argmax()
        raise UserError(
            f"{file.place_of(first)} of {path} has the colour {' '.join(map(str, points.rgb[first]))}, but COLMAP's "
            "colours range from 0 to 255; multiply all colours in the file by 255"
        )
    return points


def _collect_by_id(file: "_BinaryFile | _TextFile", what: str, parse: Callable[[Any], Record]) -> dict[int, Record]:
    """The records by their ids. UserError where two have the same id, or photos the same name."""
    found: dict[int, Record] = {}
    places: dict[str, str] = {}
    for record in file.records(what, parse):
        for key in (f"the id {record.id}", *([f"the name {record.name}"] if what == "photo" else ())):
            if key in places:
                raise _make_twice_error(file, places[key], file.place, key)
            places[key] = file.place
        found[record.id] = record
    return found


def _make_twice_error(file: "_BinaryFile | _TextFile", first: str, second: str, key: str) -> UserError:
    return UserError(
        f"{first} and {second} of {file.path} both have {key}; keep one of them, or export the model again"
    )


def _read_camera(file: "_BinaryFile | _TextFile") -> Camera:
    (id,), model = file.take("i"), file.model()
    width, height = file.take("QQ")
    return Camera(id, model.model_name, width, height, file.numbers(model.num_params))


def _read_image(file: "_BinaryFile | _TextFile", with_points: bool) -> Image:
    id, *pose, camera_id = file.take("idddddddi")
    name = file.name()
    xys, ids = file.points_2d(with_points)
    return Image(id, np.array(pose[:4]), np.array(pose[4:]), camera_id, name, xys, ids)


def _read_point(file: "_TextFile") -> tuple:
    """Read a 3D point as a row of _ROW. ValueError for numbers that are not finite or out of range."""
    id, x, y, z, red, green, blue, error = values = file.take("qddddddd")
    colored = 0 <= red <= 255 and 0 <= green <= 255 and 0 <= blue <= 255
    if not (math.isfinite(x + y + z) and colored) or id >> 63:
        raise ValueError(f"got {' '.join(map(str, values))}")
    return id, (x, y, z), (red, green, blue), error


def _read_table(path: StrPath) -> np.ndarray:
    """Read the points of a text file as rows _ROW. ValueError or a warning where `_read_point` might read others."""
    with open(path, encoding=encoding_of(path)) as file, warnings.catch_warnings():
        warnings.simplefilter("error")  # of an id with a decimal point, or of no points
        rows = np.loadtxt(file, _ROW, usecols=range(8), ndmin=1)
    rgb = rows["rgb"]
    colored = ((rgb >= 0) & (rgb <= 255)).all()
    if not (np.isfinite(rows["xyz"].sum(axis=1)).all() and colored and (rows["ids"] >= 0).all()):
        raise ValueError("not finite, or no colour")
    return rows


def _open_file(path: StrPath, binary: bool) -> "_BinaryFile | _TextFile":
    return _BinaryFile(path) if binary else _TextFile(path)


class _BinaryFile:
    """The values of a binary file, taken in order; ValueError or struct.error where it is too short."""

    _POINT = np.dtype([("ids", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("errors", "<f8"), ("seen", "<u8")])
    _TRACK = 8  # bytes for each photo that sees a point
    _POINT_2D = np.dtype([("xy", "<f8", 2), ("id", "<i8")])

    def __init__(self, path: StrPath) -> None:
        self.path, self._content, self._at = path, Path(path).read_bytes(), 0
        self.place = ""  # of the record that was read last

    def records(self, what: str, parse: Callable[["_BinaryFile"], Record]) -> Iterator[Record]:
        """Read the file's records, each by `parse`. what: their name in messages. UserError for a damaged file."""
        count, number = 1, 1
        try:
            (count,) = self.take("Q")
            while number <= count:
                self.place = f"{what} {number}"
                yield parse(self)
                number += 1
        except UnicodeDecodeError as error:
            fault = f"the name of {what} {number} in {self.path} is not UTF-8; rename it in plain letters"
            raise UserError(fault) from error
        except (struct.error, ValueError, OverflowError) as error:
            raise self._cut_short(what, number, count) from error
        except KeyError as error:
            raise UserError(
                f"{what} {number} in {self.path} has the unknown camera model {error}; convert the model with a "
                "COLMAP that knows it"
            ) from error

    def take(self, kinds: str) -> tuple:
        """A value for each letter of `struct`."""
        values = struct.unpack_from("<" + kinds, self._content, self._at)
        self._at += struct.calcsize("<" + kinds)
        return values

    def model(self) -> CameraModel:
        return CAMERA_MODEL_IDS[self.take("i")[0]]

    def numbers(self, count: int) -> np.ndarray:
        return np.array(self.take("d" * count))

    def name(self) -> str:
        end = self._content.index(b"\0", self._at)
        text, self._at = self._content[self._at : end].decode("utf-8"), end + 1
        return text

    def points_2d(self, needed: bool) -> tuple[np.ndarray, np.ndarray]:
        """Read the 2D points of a photo: pixels (N, 2) and ids of their 3D points (N,). needed: else pass over them."""
        (count,), begin = self.take("Q"), self._at
        self._at += count * self._POINT_2D.itemsize
        if self._at > len(self._content):
            raise ValueError("too short")
        rows = np.frombuffer(self._content[begin : self._at] if needed else b"", self._POINT_2D)
        return rows["xy"].copy(), rows["id"].copy()

    def points(self) -> Points:
        content, starts, count = self._content, [], 1
        number, record, length_at = struct.Struct("<Q"), self._POINT.itemsize, self._POINT.fields["seen"][1]
        at = number.size
        try:
            (count,) = self.take("Q")
            while len(starts) < count:
                (length,) = number.unpack_from(content, at + length_at)
                starts.append(at)
                at += record + self._TRACK * length
            if at > len(content):
                raise struct.error
        except (struct.error, OverflowError) as error:
            raise self._cut_short("point", len(starts) + (at <= len(content)), count) from error
        # A view has a record at every byte of the file; those at the starts are real.
        places = len(content) - self._POINT.itemsize + 1
        view = np.ndarray((places,), self._POINT, content, strides=(1,)) if starts else np.zeros(0, self._POINT)
        rows = view[starts]
        return Points(*(rows[name] for name in Points._fields))

    def place_of(self, point: int) -> str:
        return f"point {point + 1}"

    def _cut_short(self, what: str, number: int, count: int) -> UserError:
        fault = describe_wrong_file(self.path)
        fault = f"is {fault}" if fault else f"ends within {what} {number:,} of {count:,}, or is no such file"
        return UserError(f"{self.path} {fault}; copy the file again from where it was made")


@functools.cache
def _choose_converters(kinds: str) -> list[type]:
    return [float if kind == "d" else int for kind in kinds]


class _TextFile:
    """The values of a text file, taken in order; ValueError where a line has too few of them or others."""

    _LISTED = {
        "camera": "id, camera model, width, height and its parameters",
        "photo": "a photo's id, rotation, translation, camera id, name, or in the line after it x, y, id of points",
        "point": "id, finite position, colour up to 255 and error of a point",
    }

    def __init__(self, path: StrPath) -> None:
        self.path, self._number, self._line, self._rest = path, 0, "", ""
        self.place = ""  # of the record that was read last
        self._lines: Iterator[tuple[int, str]] = iter(())

    def records(self, what: str, parse: Callable[["_TextFile"], Record]) -> Iterator[Record]:
        """Read the file's records, each by `parse`. what: their name in messages. UserError for a damaged line."""
        with open(self.path, encoding=encoding_of(self.path), errors="surrogateescape") as file:
            self._lines = enumerate(file, start=1)
            try:
                for number, line in self._lines:
                    if (rest := line.lstrip()) and not rest.startswith("#"):
                        self._number, self.place = number, f"line {number}"
                        self._line = self._rest = rest
                        yield parse(self)
            except (ValueError, OverflowError) as error:
                if any("\udc80" <= letter <= "\udcff" for letter in self._line):
                    raise UserError(f"{self.path} is not UTF-8 text; rename its photos in plain letters") from error
                if other := describe_wrong_file(self.path):
                    fault = f"{self.path} is {other}; copy the file again from where it was made"
                    raise UserError(fault) from error
                raise UserError(
                    f"line {self._number} of {self.path} does not list {self._LISTED[what]} ({first_line(error)}); "
                    "fix it, or copy the file again"
                ) from error

    def points(self) -> Points:
        try:
            rows = _read_table(self.path)
        except (ValueError, Warning):  # which one it is, they say one by one, which takes ten times as long
            rows = np.array(list(self.records("point", _read_point)), dtype=_ROW)
        return Points(*(rows[name] for name in Points._fields))

    def place_of(self, point: int) -> str:
        deque(islice(self.records("point", lambda _: None), point + 1), maxlen=0)
        return self.place

    def take(self, kinds: str) -> list[int | float]:
        """A value for each letter: a float for d, else an integer."""
        words = self._rest.split(maxsplit=len(kinds))
        self._rest = words.pop() if len(words) > len(kinds) else ""
        return [convert(word) for convert, word in zip(_choose_converters(kinds), words, strict=True)]

    def model(self) -> CameraModel:
        word, self._rest = (*self._rest.split(maxsplit=1), "")[:2]
        if word not in CAMERA_MODEL_NAMES:
            raise ValueError(f"COLMAP has no camera model {word}")
        return CAMERA_MODEL_NAMES[word]

    def numbers(self, count: int) -> np.ndarray:
        values = np.array(self._rest.split(), dtype=np.float64)
        if len(values) != count:
            raise ValueError(f"{len(values)} parameters, not {count}")
        return values

    def name(self) -> str:
        if not self._rest.strip():
            raise ValueError("no name")
        self._rest.encode()  # UnicodeEncodeError for bytes of another encoding; in a comment they do no harm
        return self._rest.strip()

    def points_2d(self, needed: bool) -> tuple[np.ndarray, np.ndarray]:
        """Read the 2D points of a photo: pixels (N, 2) and ids of their 3D points (N,). needed: else pass over them."""
        self._number, line = next(self._lines, (self._number, ""))
        words = line.split()
        if not needed and len(words) % 3 == 0:  # a line that was left out would make the next photo one of points
            words = [*words[:3], *words[-3:]]
        xys = np.array(words, dtype=np.float64).reshape(-1, 3)[:, :2].copy()
        ids = np.array(words[2::3], dtype=np.int64)  # not from the floats, which hold ids to 2^53 only
        return (xys, ids) if needed else (xys[:0], ids[:0])
