"""Search for installed programs, on PATH or in the repository, but never in the current folder."""

import os
import shutil
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]


def forget_relative_path() -> None:
    """Remove entries that depend on the current folder from PATH, for this process and those it starts.

    An empty entry stands for the current folder, too.
    """
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    os.environ["PATH"] = os.pathsep.join(filter(os.path.isabs, folders))


def find_program(name: str) -> str | None:
    """The absolute path of a program; None if there is none of that name.

    name: a path is taken as it is; a bare name is looked for on PATH and in the repository's node_modules.
    """
    if os.path.dirname(name):
        return os.path.abspath(name)
    forget_relative_path()
    found = shutil.which(name, path=os.pathsep.join([os.environ["PATH"], str(_ROOT / "node_modules" / ".bin")]))
    return found if found and os.path.isabs(found) else None  # Windows looks in the current folder first
