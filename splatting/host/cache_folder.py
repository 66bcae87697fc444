"""Folder that keeps reproducible results between runs."""

import os
from pathlib import Path

NAME = "gaussian-splatting"


def cache_folder() -> Path:
    """The folder $GS_CACHE, else `gaussian-splatting` in $XDG_CACHE_HOME or ~/.cache. It may not exist yet."""
    if given := os.environ.get("GS_CACHE"):
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME", "")
    # By the XDG base directory specification, a relative path is ignored.
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / NAME
