"""Folders that outlive a program: locks of output folders, removal of temporary files, and the cache."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from groundwork.host.errors import UserError

_TEMPORARY = re.compile(r"\..*\.(\d+)\.tmp(\.[^.]*)?")  # as `atomic_write` names them
_LINGER = 2.0  # seconds in which children of a killed program may still have its lock, before they begin their own work


@contextlib.contextmanager
def locked(folder: Path, program: str, busy: str, option: str, inherited: bool = False) -> Iterator[None]:
    """Keep `folder` for this process. UserError if another process has it.

    program: the command; the lock's file has its name.
    busy: the message's words on the process that has the folder.
    option: the option that names another folder, for the message.
    inherited: child processes that inherit open files keep the folder, too, until the last of them ends; the lock's
    file then stays.

    The system releases the lock when its last process ends in any way, so a killed one does not block the folder.
    Without file locks (some network file systems) this does nothing.
    """
    path = folder / f".{program.removesuffix('.py')}.lock"
    with contextlib.ExitStack() as stack:
        file = _lock_file(stack, path, busy, option)
        if file is None:
            yield
            return
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        os.set_inheritable(file.fileno(), inherited)
        try:
            yield
        finally:
            if not inherited and _is_at(file, path):
                with contextlib.suppress(OSError):
                    path.unlink()


def _lock_file(stack: contextlib.ExitStack, path: Path, busy: str, option: str) -> TextIO | None:
    """Lock the file, which `stack` closes; None where files cannot be locked."""
    latest = time.monotonic() + _LINGER
    while True:
        try:
            file = stack.enter_context(path.open("a+", encoding="utf-8"))
        except OSError as error:
            raise UserError(f"cannot write {path} ({error.strerror}); choose another {option}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            process = file.read().strip() or "not known"
            if process.isdigit() and not _is_running(int(process)) and time.monotonic() < latest:
                file.close()
                time.sleep(0.05)
                continue
            raise UserError(
                f"{busy.format(process=process)} is running in {path.parent}; wait for it, stop it, or choose another "
                f"{option}"
            ) from error
        except OSError:
            return None
        if _is_at(file, path):
            return file
        # Its owner has removed the file between our two calls, so the next one may hold another file.


def _is_at(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False


def remove_temporary_files(folder: str | os.PathLike) -> list[Path]:
    """Remove the files below a folder that `atomic_write` of ended processes has left; return their paths."""
    removed = []
    for parent, _, names in os.walk(folder):
        for name in names:
            if (match := _TEMPORARY.fullmatch(name)) and not _is_running(int(match[1])):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(parent, name))
                    removed.append(Path(parent, name))
    return removed


def _is_running(process: int) -> bool:
    """Tell whether a process, by its number, runs on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # somebody else's; a number that no process has
        pass
    return True


def cache_folder() -> Path:
    """Folder of results that can be made again. It may not exist yet.

    It is $GS_CACHE, else `gaussian-splatting` in $XDG_CACHE_HOME or ~/.cache.
    """
    if given := os.environ.get("GS_CACHE"):
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME", "")
    # By the XDG base directory specification, a relative path is ignored.
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "gaussian-splatting"
