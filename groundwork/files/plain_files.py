"""Files that a user or a dataset names: devices, pipes, endless texts and failed downloads are refused."""

import codecs
import errno
import os
import stat
from pathlib import Path
from typing import TypeVar

MOST = 1 << 28  # bytes of a text
_FREE = 1 << 16  # rows that any file may have: some 50 MB as splats
Name = TypeVar("Name", str, os.PathLike)


def plain_path(path: Name) -> Name:
    """Return the path. OSError if it names a device, a pipe or a socket; a missing file raises nothing here."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return path
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a device or a pipe, not a file", os.fspath(path))
    return path


def plain_text(path: str | os.PathLike, errors: str = "strict") -> str:
    """Read a text file in the encoding of `encoding_of`.

    OSError if the file cannot be read or has more than MOST bytes; ValueError for bytes that are no such text.

    errors: as for `open`.
    """
    if os.path.getsize(plain_path(path)) > MOST:
        raise OSError(errno.EFBIG, f"it has more than {MOST >> 20} MiB", os.fspath(path))
    return Path(path).read_text(encoding=encoding_of(path), errors=errors)


def encoding_of(path: str | os.PathLike) -> str:
    """Return UTF-16 or UTF-32 if a file begins with its mark, as PowerShell writes it; else UTF-8, marked or not."""
    with open(plain_path(path), "rb") as file:
        head = file.read(4)
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        return "utf-32"
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    zeros = [byte == 0 for byte in head]  # without a mark, every second byte of plain letters is zero
    return {(False, True) * 2: "utf-16-le", (True, False) * 2: "utf-16-be"}.get(tuple(zeros), "utf-8-sig")


def describe_wrong_file(path: str | os.PathLike) -> str | None:
    """Describe a file that is empty, a Git LFS pointer or a web page; None for any other file."""
    try:
        with open(plain_path(path), "rb") as file:
            head = file.read(256)
    except OSError:
        return None
    if not head:
        return "empty"
    if head.startswith(b"version https://git-lfs"):
        return "a Git LFS pointer (git lfs pull downloads its content)"
    if head.lstrip()[:9].lower().startswith((b"<!doctype", b"<html")):
        return "a web page, likely from a wrong address"
    return None


def check_packed_rows(count: int, size: int) -> None:
    """ValueError if a compressed file of `size` bytes promises more splats or points than honest ones have.

    More than 65,536 are refused if they exceed the file's bytes: a trained splat takes 10 bytes or more, and one of a
    lattice of equal splats, compressed as well as possible, 0.95.
    """
    if count > size + _FREE:
        raise ValueError(f"its header announces {count:,} rows, but the file has only {size:,} bytes")
