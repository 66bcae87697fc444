"""Descriptions of the fault in a COLMAP model that pycolmap refuses, for the user who has to fix it."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from scene.pictures.pycolmap_import import import_pycolmap
from utils.files.file_kinds import not_the_file

NAMES = ("cameras", "images", "points3D")
_SHOWN = 60  # most characters of a line in a message


def describe(folder: Path, suffix: str, error: Exception) -> str:
    """Part of a message: the file and line at fault if they can be found, else the files' sizes and the error."""
    paths = [folder / f"{name}.{suffix}" for name in NAMES]
    for path in paths:
        if other := not_the_file(path):
            return f"{path.name} is {other}"
    try:
        line = _text_fault(*paths) if suffix == "txt" else None
    except (OSError, UnicodeDecodeError):
        line = None
    if line:
        return line
    sizes = ", ".join(f"{path.name} {path.stat().st_size:,} bytes" for path in paths)
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    if reason.startswith("[") or isinstance(error, LookupError):  # a check inside COLMAP, which says nothing to users
        return f"{sizes}: their contents do not fit together"
    return f"{sizes}: {reason}"


def _text_fault(cameras: Path, images: Path, points: Path) -> str | None:
    known = import_pycolmap().CameraModelId.__members__
    ids = set()
    for number, words in _data_lines(cameras):
        if len(words) < 5 or not _are_numbers([words[0], *words[2:]]):
            return _line(cameras, number, words, "does not list an id, a camera model and numbers")
        if words[1] not in known:
            return _line(cameras, number, words, f"has the camera model {words[1]}, which COLMAP does not have")
        ids.add(words[0])
    for index, (number, words) in enumerate(_data_lines(images, keep_empty=True)):
        if index % 2:
            continue  # a line of 2D points
        if len(words) < 10 or not _are_numbers(words[:9]):
            return _line(
                images, number, words, "does not list an id, rotation, translation, camera id, all finite, and name"
            )
        if words[8] not in ids:
            return _line(images, number, words, f"has the camera {words[8]}, which is not in {cameras.name}")
    for number, words in _data_lines(points):
        if len(words) < 8 or not _are_numbers(words[:8]):
            return _line(points, number, words, "does not list an id, position, colour and error, all finite numbers")
    return None


def _data_lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Number (from 1) and words of all lines except comments. keep_empty: also of empty lines after the first one."""
    begun = False
    with open(path, encoding="utf-8") as file:
        for number, line in enumerate(file, start=1):
            words = line.split()
            if line.startswith("#") or not (words or (keep_empty and begun)):
                continue
            begun = True
            yield number, words


def _are_numbers(words: Sequence[str]) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _line(path: Path, number: int, words: Sequence[str], what: str) -> str:
    text = " ".join(words)
    shown = text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
    return f"line {number} of {path.name} {what} ({shown})"
