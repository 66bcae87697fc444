"""Locks of output folders, so that one program of a kind works in a folder at a time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from utils.system_utils import UserError

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt

    fcntl = None

_FAR = 1 << 30  # Windows keeps other programs from reading a byte that is locked, so one behind the content is locked


@contextlib.contextmanager
def locked(folder: Path, program: str, busy: str, option: str, inherited: bool = False) -> Iterator[None]:
    """Keep `folder` for this process. UserError if another process has it.

    program: the command, which names the file of the lock. busy: words for the message about the process that has it.
    option: with which the user names another folder. inherited: child processes that inherit open files keep the
    folder, too, until the last of them ends; then the lock's file stays.
    The system releases the lock when its last process ends in any way, so a killed one does not block the folder. On
    Windows child processes do not inherit it, and the lock's file stays. Without file locks (some network file systems)
    this does nothing.
    """
    path = folder / f".{program.removesuffix('.py')}.lock"
    with contextlib.ExitStack() as stack:
        file = _acquired(stack, path, busy, option)
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


def _acquired(stack: contextlib.ExitStack, path: Path, busy: str, option: str) -> TextIO | None:
    """The locked file, which `stack` closes; None where files cannot be locked."""
    while True:
        try:
            file = stack.enter_context(path.open("a+", encoding="utf-8"))
        except OSError as error:
            raise UserError(f"cannot write {path} ({error.strerror}); choose another {option}") from error
        try:
            _lock(file)
        except BlockingIOError as error:
            file.seek(0)
            process = file.read().strip() or "not known"
            raise UserError(
                f"{busy.format(process=process)} is at work in {path.parent}; wait for it, stop it, or choose another "
                f"{option}"
            ) from error
        except OSError:
            return None
        if _is_at(file, path):
            return file
        # Its owner has removed the file between our two calls, so the next one may hold another file.


def _lock(file: TextIO) -> None:
    """Lock a file until it is closed. BlockingIOError if another process has it."""
    if fcntl:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        os.lseek(file.fileno(), _FAR, os.SEEK_SET)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError(*error.args) from error


def _is_at(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False
