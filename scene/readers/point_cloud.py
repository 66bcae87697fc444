"""Coloured point clouds in files: PLY, npz and text are read, PLY is written.

Text has its columns by the names of a header, else by their number. A header is a first line of names, also behind //
or #, as CloudCompare writes it; a count of points may stand before or behind it (.pts). Without a header the columns
are x y z and red green blue; with one more, an intensity before the colours in files with a count, else any value
behind them; with three more, normals before or behind the colours. Numbers are split by spaces, tabs, commas or
semicolons; with semicolons, or between the digits of numbers apart, a comma is a decimal point.
"""

import io
import os
import re
import sys
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from groundwork.files.plain_files import check_packed_rows, encoding_of
from groundwork.files.ply_header import read_elements
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import SH2RGB
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
_SH = ("f_dc_0", "f_dc_1", "f_dc_2")
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"), _SH)
_TEXT_COLORS = (("r", "g", "b"), ("rf", "gf", "bf"), ("red", "green", "blue"))
# Three or more numbers with commas as decimal points.
_DECIMAL_COMMAS = re.compile(r"\s*(?=.*\d,\d)([-+]?\d+(,\d+)?(e[-+]?\d+)?(\s+|$)){3,}", re.IGNORECASE)
_LOOKED_AT = 100  # lines
_OTHERS = {".pcd": b"# .PCD", ".las": b"LASF", ".laz": b"LASF", ".e57": b"ASTM-E57"}  # and how they begin
_UNIT = 0.01  # departure of a normal's length from 1 in rounded files of text
_GREY = 127 / 255


def is_ply(path: Path) -> bool:
    """Tell whether the file starts with the magic of a PLY."""
    return _begins_with(path, b"ply")


def read_point_cloud(path: Path) -> BasicPointCloud:
    """Points (float64) with colours (float32) and normals (0 where missing) of a file, whose content decides its kind.

    PLY: x y z and red green blue by their usual names. npz: `points` or `xyz` (N,3), `colors` or `rgb` (N,3). Text: as
    the header of this module says. Colours range to 255, or of floats to 1 if none is above 1, or of integers to 65,535
    if one is above 255. Points without colours are grey, and a message says so.
    UserError for a file that is missing, of another kind, or has points that are not finite.
    """
    cloud = _read_cloud(path)
    return BasicPointCloud(cloud.points, cloud.colors.astype(np.float32), cloud.normals)


def fetchPly(path: str | os.PathLike) -> BasicPointCloud:
    """The cloud of a file as the reference gives it: points float32, colours float64 in [0,1]; normals 0 where missing.

    Points that float32 cannot hold stay float64. Kinds of files and errors as for `read_point_cloud`.
    """
    cloud = _read_cloud(Path(path))
    points = cloud.points.astype(np.float32)
    points = points if np.array_equal(points, cloud.points) else cloud.points
    return BasicPointCloud(points, cloud.colors.astype(np.float64), cloud.normals)


def storePly(path: str | os.PathLike, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write points (N,3), stored as float32, with colours (N,3) from 0 to 255, decimals dropped, and zero normals."""
    write_point_cloud(Path(path), np.asarray(xyz), np.clip(np.asarray(rgb), 0, 255).astype(np.uint8))


@np.errstate(over="ignore")  # doubles that float32 cannot hold become Inf, which is refused
def _read_cloud(path: Path) -> BasicPointCloud:
    """The cloud with colours as exact as the file has them."""
    if not os.path.isfile(path):  # Path.is_file raises an error for a name that is too long
        raise UserError(f"no point cloud {path}; give the path of a PLY, npz or text file of points")
    if path.suffix.lower() in _OTHERS or any(_begins_with(path, magic) for magic in _OTHERS.values()):
        raise UserError(
            f"{path} is a point cloud of a kind that is not read; save it as PLY, for instance by CloudCompare"
        )
    if is_ply(path) or path.suffix.lower() == ".ply":
        points, colors, normals = _read_ply(path)
    else:
        points, colors = _read_npz(path) if _begins_with(path, b"PK") else _read_text(path)
        normals = np.zeros_like(points, dtype=np.float32)
    check_finite(points, path)
    if colors is None:
        print(f"{path} has no colours; its points begin grey", file=sys.stderr)
        return BasicPointCloud(points, np.full(points.shape, _GREY), normals)
    return BasicPointCloud(points, color_fractions(colors, path), normals)


def _begins_with(path: Path, magic: bytes) -> bool:
    """Tell whether a file begins with some bytes. UserError if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(len(magic)) == magic
    except OSError as error:
        raise UserError(f"cannot read the point cloud {path} ({error.strerror}); fix its permissions") from error


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Points, colours (None: there are none) and normals, (N,3) each."""
    try:
        ply = read_elements(path)
    except (PlyParseError, ValueError, OverflowError, OSError, EOFError, MemoryError) as error:
        raise UserError(f"{path} is not a readable PLY file ({error}); export the point cloud again") from error
    vertices = ply["vertex"].data if "vertex" in ply else np.zeros(0, dtype=[])
    names = {name.lower().removeprefix("scalar_"): name for name in vertices.dtype.names or ()}
    missing = [name for name in _POSITION if name not in names]
    if missing:
        raise UserError(f"the point cloud {path} has no {', '.join(missing)}; it needs x y z and red green blue")
    try:
        points = _stack_columns(vertices, names, _POSITION).astype(np.float64)
        normals = np.zeros_like(points, dtype=np.float32)
        if names.keys() >= set(_NORMAL):
            normals[:] = _stack_columns(vertices, names, _NORMAL)
        channels = next((group for group in _COLORS if names.keys() & set(group)), None)
        if channels is None:
            return points, None, normals
        missing = [name for name in channels if name not in names]
        if missing:
            raise UserError(f"the point cloud {path} has {channels[0]} but no {', '.join(missing)}; export it again")
        colors = _stack_columns(vertices, names, channels)
    except (TypeError, ValueError) as error:
        raise UserError(f"the point cloud {path} has lists instead of numbers; export it again") from error
    if channels == _SH:  # a Gaussian model
        colors = np.clip(SH2RGB(colors), 0, 1)
    return points, colors, normals


def _stack_columns(vertices: np.ndarray, names: Mapping[str, str], wanted: Sequence[str]) -> np.ndarray:
    return np.stack([vertices[names[name]] for name in wanted], axis=1)


def color_fractions(colors: np.ndarray, path: object) -> np.ndarray:
    """Colours (N,3) in [0,1], by the greatest value that their numbers tell of. UserError, naming the path, for others.

    Floats range to 1 or 255, integers to 255 or 65,535.
    """
    if colors.dtype == np.int8:
        colors = colors.view(np.uint8)  # bytes, as C's char has them
    low, high = (colors.min(), colors.max()) if colors.size else (0, 0)
    whole = np.issubdtype(colors.dtype, np.integer)
    nearly_one = not whole and 1 < high < 2 and (colors % 1).any()  # neither range, and black as part of 255
    if nearly_one or not (low >= 0 and high <= (65535 if whole else 255)):
        raise UserError(
            f"colours in {path} are neither integers nor between 0 and 1: they range from {low:g} to {high:g}; "
            "save red green blue as uchar"
        )
    if whole:
        return colors / (65535 if high > 255 else 255)
    return colors / (255 if high > 1 else 1.0)


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read points (N, 3) float64 and colours (N, 3), None without, from an .npz file."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            points, colors = (
                next((_read_array(arrays, name, os.path.getsize(path)) for name in names if name in arrays), None)
                for names in (("points", "xyz"), ("colors", "rgb"))
            )
        if points is None:
            raise ValueError(_NEEDS)
        if colors is not None and len(colors) != len(points):
            raise ValueError(f"{len(points)} points and {len(colors)} colours")
        return points.astype(np.float64, copy=False), colors
    except _NPZ_FAULTS as error:
        raise UserError(
            f"{path} is not a readable npz file of points ({error}); save points and colors (N,3) by numpy.savez"
        ) from error


def _read_array(arrays: np.lib.npyio.NpzFile, name: str, size: int) -> np.ndarray:
    """An array (N,3) of an npz file of `size` bytes. ValueError before memory is taken for another one."""
    with arrays.zip.open(f"{name}.npy") as file:
        member = io.BytesIO(file.read(_LONGEST_HEADER))
        first = np.lib.format.read_magic(member) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, _, kind = read_header(member)
    if len(shape) != 2 or shape[1] != 3 or kind.kind not in "biuf":
        raise ValueError(_NEEDS)
    check_packed_rows(shape[0], size)
    return arrays[name]


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and colours (N,3) float64 as the file has them; None where it has no colours. UserError for other text."""
    try:
        lines = path.read_text(encoding=encoding_of(path), errors="replace").splitlines()
        first, header, counted = _read_text_header(lines)
        lines = lines[first:]
        if any(";" in line or _DECIMAL_COMMAS.fullmatch(line) for line in lines[:_LOOKED_AT]):
            lines = [line.replace(",", ".").replace(";", " ") for line in lines]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about an empty file
            table = np.loadtxt([line.replace(",", " ") for line in lines], dtype=np.float64, ndmin=2)
        if not table.size:
            raise ValueError("no numbers")
        points, colors = _choose_columns(table, header, counted or path.suffix.lower() == ".pts")
    except (ValueError, OSError, MemoryError) as error:
        raise UserError(
            f"{path} is neither PLY nor npz, and not text with x y z or x y z red green blue a line ({error}); export "
            "the point cloud again"
        ) from error
    return table[:, points], None if colors is None else table[:, colors]


def _read_text_header(lines: list[str]) -> tuple[int, list[str], bool]:
    """The index of the first line of numbers, the names of columns before it, and whether a count of points is."""
    header, counted = [], False
    for index, line in enumerate(lines):
        words = re.split(r"[\s,;]+", line.strip().lstrip("/#").strip().lower())
        if line.lstrip()[:1].isalpha() or line.lstrip().startswith(("#", "//", '"')):
            words = [word.strip('"').removeprefix("diffuse_") for word in words]
            header = words if set(words) >= set(_POSITION) else header
        elif len(words) == 1 and words[0].isdecimal() and not counted:
            counted = True
        elif words != [""]:
            return index, header, counted
    return len(lines), header, counted


def _choose_columns(table: np.ndarray, header: list[str], counted: bool) -> tuple[list[int], list[int] | slice | None]:
    """The columns of positions, and those of colours, None without any. ValueError for an unknown number of them."""
    count = table.shape[1]
    if len(header) == count:
        named = next((names for names in _TEXT_COLORS if set(header) >= set(names)), None)
        return [header.index(name) for name in _POSITION], named and [header.index(name) for name in named]
    behind, last = slice(3, 6), slice(count - 3, count)
    if count in (3, 4) or (count == 6 and _are_normals(table[:, behind])):
        return [0, 1, 2], None
    if count == 6:
        return [0, 1, 2], behind
    if count == 9:
        return [0, 1, 2], last if _are_normals(table[:, behind]) else behind
    if count == 7:
        fits = [_are_colors(table[:, columns]) for columns in (behind, last)]
        varies = [np.ptp(table[:, column]) > 0 for column in (3, 6)]  # a channel does; flags and alpha may not
        if not counted and all(fits) and varies[0] == varies[1]:
            raise ValueError("7 columns, of which those from the 4th or from the 5th on may be red green blue; write a "
                             "first line of names, such as x y z intensity red green blue")  # fmt: skip
        return [0, 1, 2], behind if not counted and fits[0] and not (fits[1] and varies[1]) else last
    raise ValueError(f"{count} columns, whose first line does not name them")


def _are_normals(values: np.ndarray) -> bool:
    return bool((np.abs(np.linalg.norm(values, axis=1) - 1) < _UNIT).all() and (values % 1).any() and values.min() < 0)


def _are_colors(values: np.ndarray) -> bool:
    return bool(values.min() >= 0 and (values.max() <= 1 or (values.max() <= 255 and not (values % 1).any())))


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
    columns = [(name, "<f4") for name in _POSITION + _NORMAL] + [(name, "u1") for name in _COLORS[0]]
    vertices = np.zeros(len(points), dtype=columns)
    for index, name in enumerate(_POSITION):
        vertices[name] = points[:, index]
    for index, name in enumerate(_COLORS[0]):
        vertices[name] = colors[:, index]
    with atomic_write(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))
