"""COLMAP's database, opened while others read it."""

import time

import pycolmap

_TRIES, _PAUSE = 50, 0.1  # seconds


def opened(path: str) -> pycolmap.Database:
    """pycolmap's database of a path.

    Opening it needs the file for itself and gives up at once, and the progress bar reads it now and then.
    """
    for _ in range(_TRIES - 1):
        try:
            return pycolmap.Database.open(path)
        except RuntimeError:
            time.sleep(_PAUSE)
    return pycolmap.Database.open(path)
