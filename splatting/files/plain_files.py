"""Files that a user or a dataset names, refused where a read might never end: devices, pipes, endless texts."""

import errno
import os
import stat
from pathlib import Path
from typing import TypeVar

MOST = 1 << 28  # bytes of a text
Name = TypeVar("Name", str, os.PathLike)


def plain(path: Name) -> Name:
    """The path. OSError if it names a device, a pipe or a socket; what is missing is left to those who open it."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return path
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a device or a pipe, not a file", os.fspath(path))
    return path


def plain_text(path: str | os.PathLike, errors: str = "strict") -> str:
    """The UTF-8 text of a file. OSError if it cannot be read, or has more than MOST bytes; ValueError for other bytes.

    errors: as for `open`.
    """
    if os.path.getsize(plain(path)) > MOST:
        raise OSError(errno.EFBIG, f"it has more than {MOST >> 20} MiB", os.fspath(path))
    return Path(path).read_text(encoding="utf-8", errors=errors)
