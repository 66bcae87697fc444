"""Removal of temporary files that killed processes left behind."""

import contextlib
import os
import re
from pathlib import Path

_TEMPORARY = re.compile(r"\..*\.(\d+)\.tmp(\.[^.]*)?")  # as `utils.system_utils.atomic_write` names them


def remove_temporary_files(folder: str | os.PathLike) -> list[Path]:
    """Remove the temporary files of `atomic_write` below a folder whose process runs no more; return their paths."""
    removed = []
    for parent, _, names in os.walk(folder):
        for name in names:
            if (match := _TEMPORARY.fullmatch(name)) and not _runs(int(match[1])):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(parent, name))
                    removed.append(Path(parent, name))
    return removed


def _runs(process: int) -> bool:
    if os.name == "nt":  # there, asking for a process would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # somebody else's; a number that no process has
        pass
    return True
