"""Paths relative to a folder."""

import os
from pathlib import Path


def relative_to(path: Path, folder: str | os.PathLike) -> Path:
    """The way from a folder to a path, through parent folders if need be; the path itself if on another drive."""
    try:
        return Path(os.path.relpath(path, folder))
    except ValueError:  # there is no way from one drive to another
        return path
