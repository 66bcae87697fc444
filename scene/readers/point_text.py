"""Text files of points: columns by the names of a header, else by their number.

A header is a first line of names, also behind // or #, as CloudCompare writes it; a count of points may stand before or
behind it (.pts). Without a header the columns are x y z and red green blue; with one more, an intensity before the
colours in files with a count, else any value behind them; with three more, normals before or behind the colours.
Numbers are split by spaces, tabs, commas or semicolons; with semicolons a comma is a decimal point.
"""

import re
import warnings
from pathlib import Path

import numpy as np

from splatting.files.plain_files import encoding_of
from utils.system_utils import UserError

_POSITION, _COLORS = ("x", "y", "z"), (("r", "g", "b"), ("rf", "gf", "bf"), ("red", "green", "blue"))
_UNIT = 0.01  # departure of a normal's length from 1 in rounded files


def read_text(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and colours (N,3) float64 as the file has them; None where it has no colours. UserError for other text."""
    try:
        lines = path.read_text(encoding=encoding_of(path), errors="replace").splitlines()
        first, header, counted = _begin(lines)
        lines = lines[first:]
        if any(";" in line for line in lines[:1]):
            lines = [line.replace(",", ".").replace(";", " ") for line in lines]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about an empty file
            table = np.loadtxt([line.replace(",", " ") for line in lines], dtype=np.float64, ndmin=2)
        if not table.size:
            raise ValueError("no numbers")
        points, colors = _places(table, header, counted or path.suffix.lower() == ".pts")
    except (ValueError, OSError, MemoryError) as error:
        raise UserError(
            f"{path} is neither PLY nor npz, and not text with x y z or x y z red green blue a line ({error}); export "
            "the point cloud again"
        ) from error
    return table[:, points], None if colors is None else table[:, colors]


def _begin(lines: list[str]) -> tuple[int, list[str], bool]:
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


def _places(table: np.ndarray, header: list[str], counted: bool) -> tuple[list[int], list[int] | slice | None]:
    """The columns of positions, and those of colours, None without any. ValueError for an unknown number of them."""
    count = table.shape[1]
    if len(header) == count:
        named = next((names for names in _COLORS if set(header) >= set(names)), None)
        return [header.index(name) for name in _POSITION], named and [header.index(name) for name in named]
    behind, last = slice(3, 6), slice(count - 3, count)
    if count in (3, 4) or (count == 6 and _are_normals(table[:, behind])):
        return [0, 1, 2], None
    if count == 6:
        return [0, 1, 2], behind
    if count == 9:
        return [0, 1, 2], last if _are_normals(table[:, behind]) else behind
    if count == 7:
        return [0, 1, 2], last if counted or not _are_colors(table[:, behind]) else behind
    raise ValueError(f"{count} columns, whose first line does not name them")


def _are_normals(values: np.ndarray) -> bool:
    return bool((np.abs(np.linalg.norm(values, axis=1) - 1) < _UNIT).all() and (values % 1).any() and values.min() < 0)


def _are_colors(values: np.ndarray) -> bool:
    return bool(values.min() >= 0 and (values.max() <= 1 or (values.max() <= 255 and not (values % 1).any())))
