"""Coloured point clouds in files: PLY, npz and text are read, PLY is written."""

import io
import os
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from splatting.files.plain_files import check_packed_rows
from splatting.files.ply_header import read_elements
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError, atomic_write

# What NumPy and the reader of archives raise for damaged files: the last two for compression and encryption.
_NPZ_FAULTS = (
    *(ValueError, TypeError, OSError, EOFError, KeyError, MemoryError, zipfile.BadZipFile, zlib.error),
    *(NotImplementedError, RuntimeError),
)
_LONGEST_HEADER = 1 << 14  # bytes; those of arrays of numbers have 128, and NumPy would unpack up to 4 GiB
_NEEDS = "it needs an array points (N,3), and may have colors (N,3)"
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOR = ("red", "green", "blue")


def is_ply(path: Path) -> bool:
    """Whether the file starts with the magic of a PLY."""
    return _begins_with(path, b"ply")


def read_point_cloud(path: Path) -> BasicPointCloud:
    """Points (float64) with colours (float32) and normals (0 where missing) of a file, whose content decides its kind.

    PLY: x y z red green blue, integers as fractions of their type's maximum. npz: `points` or `xyz` (N,3), `colors` or
    `rgb` (N,3). Text: three or six numbers a line, x y z and red green blue, split by spaces or commas. In the last two
    kinds colours range to 1, or to 255 if any is above 1; points without colours are grey.
    UserError for a file that is missing, of another kind, or has points that are not finite.
    """
    cloud = _read(path)
    return BasicPointCloud(cloud.points, cloud.colors.astype(np.float32), cloud.normals)


def fetchPly(path: str | os.PathLike) -> BasicPointCloud:
    """The cloud of a file as the reference gives it: points float32, colours float64 in [0,1]; normals 0 where missing.

    Points that float32 cannot hold stay float64. Kinds of files and errors as for `read_point_cloud`.
    """
    cloud = _read(Path(path))
    points = cloud.points.astype(np.float32)
    points = points if np.array_equal(points, cloud.points) else cloud.points
    return BasicPointCloud(points, cloud.colors.astype(np.float64), cloud.normals)


def storePly(path: str | os.PathLike, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write points (N,3), stored as float32, with colours (N,3) from 0 to 255, decimals dropped, and zero normals."""
    write_point_cloud(Path(path), np.asarray(xyz), np.clip(np.asarray(rgb), 0, 255).astype(np.uint8))


@np.errstate(over="ignore")  # doubles that float32 cannot hold become Inf, which is refused
def _read(path: Path) -> BasicPointCloud:
    """The cloud with colours as exact as the file has them."""
    if not os.path.isfile(path):  # Path.is_file raises an error for a name that is too long
        raise UserError(f"no point cloud {path}; give the path of a PLY, npz or text file of points")
    if is_ply(path) or path.suffix.lower() == ".ply":
        cloud = _read_ply(path)
    else:
        table = _read_npz(path) if _begins_with(path, b"PK") else _read_text(path)
        cloud = _from_table(table)
    check_finite(cloud.points, path)
    colors = cloud.colors.astype(np.float32)
    if not ((colors >= 0) & (colors <= 1)).all():
        raise UserError(f"colours in {path} are neither integers nor between 0 and 1; save red green blue as uchar")
    return cloud


def _begins_with(path: Path, magic: bytes) -> bool:
    try:
        with open(path, "rb") as file:
            return file.read(len(magic)) == magic
    except OSError as error:
        raise UserError(f"cannot read the point cloud {path} ({error.strerror}); fix its permissions") from error


def _read_ply(path: Path) -> BasicPointCloud:
    try:
        ply = read_elements(path)
    except (PlyParseError, ValueError, OverflowError, OSError, EOFError, MemoryError) as error:
        raise UserError(f"{path} is not a readable PLY file ({error}); export the point cloud again") from error
    vertices = ply["vertex"].data if "vertex" in ply else np.zeros(0, dtype=[])
    names = vertices.dtype.names or ()
    missing = [name for name in _POSITION + _COLOR if name not in names]
    if missing:
        raise UserError(f"the point cloud {path} has no {', '.join(missing)}; it needs x y z red green blue per vertex")
    try:
        points = np.stack([vertices[name] for name in _POSITION], axis=1).astype(np.float64)
        colors = np.stack([_fraction(vertices[name]) for name in _COLOR], axis=1)
        has_normals = all(name in names for name in _NORMAL)
        normals = np.zeros_like(points, dtype=np.float32)
        if has_normals:
            normals[:] = np.stack([vertices[name] for name in _NORMAL], axis=1)
    except (TypeError, ValueError) as error:
        raise UserError(f"the point cloud {path} has lists instead of numbers; export it again") from error
    return BasicPointCloud(points, colors, normals)


def _read_npz(path: Path) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            points, colors = (
                next((_read_array(arrays, name, os.path.getsize(path)) for name in names if name in arrays), None)
                for names in (("points", "xyz"), ("colors", "rgb"))
            )
        if points is None:
            raise ValueError(_NEEDS)
        return np.concatenate([points] if colors is None else [points, colors], axis=1)
    except _NPZ_FAULTS as error:
        raise UserError(
            f"{path} is not a readable npz file of points ({error}); save points and colors (N,3) by numpy.savez"
        ) from error


def _read_array(arrays: np.lib.npyio.NpzFile, name: str, size: int) -> np.ndarray:
    """An array (N,3) of an npz file of `size` bytes, float64. ValueError before memory is taken for another one."""
    with arrays.zip.open(f"{name}.npy") as file:
        member = io.BytesIO(file.read(_LONGEST_HEADER))
        first = np.lib.format.read_magic(member) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, _, kind = read_header(member)
    if len(shape) != 2 or shape[1] != 3 or kind.kind not in "biuf":
        raise ValueError(_NEEDS)
    check_packed_rows(shape[0], size)
    return arrays[name].astype(np.float64, copy=False)


def _read_text(path: Path) -> np.ndarray:
    try:
        lines = path.read_text(encoding="utf-8").replace(",", " ").replace(";", " ").splitlines()
        # A first line that starts with a letter names the columns.
        skip = 1 if lines and lines[0].lstrip()[:1].isalpha() else 0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about an empty file
            table = np.loadtxt(lines[skip:], dtype=np.float64, ndmin=2)
        if not table.size or table.shape[1] not in (3, 6):
            raise ValueError(f"{table.shape[1]} columns" if table.size else "no numbers")
    except (ValueError, OSError, MemoryError) as error:
        raise UserError(
            f"{path} is neither PLY nor npz, and not text with x y z or x y z red green blue a line ({error}); export "
            "the point cloud again"
        ) from error
    return table


def _from_table(table: np.ndarray) -> BasicPointCloud:
    """Cloud of a table (N, 3 or 6) of x y z and red green blue."""
    points, colors = table[:, :3], table[:, 3:]
    if not colors.shape[1]:
        colors = np.full_like(table[:, :3], 127 / 255)
    elif colors.size and colors.max() > 1:
        colors = colors / 255
    return BasicPointCloud(points, colors, np.zeros_like(points, dtype=np.float32))


def check_finite(points: np.ndarray, path: Path) -> None:
    """UserError naming the first of the points (N,3) of a file that is not finite in float32."""
    with np.errstate(over="ignore"):
        bad = ~np.isfinite(points.astype(np.float32)).all(axis=1)
    if bad.any():
        raise UserError(
            f"{bad.sum()} of {len(bad)} points in {path} are not finite (first: number {bad.argmax()}); "
            "remove them from the cloud"
        )


def write_point_cloud(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write points (N,3), stored as float32, with colours (N,3) uint8 and zero normals, in the reference's layout."""
    columns = [(name, "<f4") for name in _POSITION + _NORMAL] + [(name, "u1") for name in _COLOR]
    vertices = np.zeros(len(points), dtype=columns)
    for index, name in enumerate(_POSITION):
        vertices[name] = points[:, index]
    for index, name in enumerate(_COLOR):
        vertices[name] = colors[:, index]
    with atomic_write(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def _fraction(values: np.ndarray) -> np.ndarray:
    top = np.iinfo(values.dtype).max if np.issubdtype(values.dtype, np.integer) else 1.0
    return values / top
