"""Lock of an output folder, so that one full_eval.py works in it at a time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from utils.system_utils import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

NAME = ".full_eval.lock"


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep `folder` for this process and its `run_child` processes. UserError if another process has it.

    The system releases the lock when the last of them ends in any way. So a killed full_eval.py does not block the
    folder, but a training that outlives it does. Without file locks (Windows, some network file systems) this does
    nothing.
    """
    if fcntl is None:
        yield
        return
    path = folder / NAME
    try:
        file = path.open("a+", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path} ({error.strerror}); choose another --output_path") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise UserError(
                f"full_eval.py (process {file.read().strip() or 'not known'}), or a training that it started, is at "
                f"work in {folder}; wait for it, stop it, or choose another --output_path"
            ) from error
        except OSError:
            yield
            return
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        os.set_inheritable(file.fileno(), True)
        yield
