"""One full_eval.py in an output folder at a time."""

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
    """Keep `folder` for this process and what it starts by `run_child`. UserError where another has it.

    The system lets go of it when the last of them ends, however that happens: what a killed one leaves is no obstacle,
    and a training that outlives its full_eval.py still is one. Without file locks (Windows, some network file systems)
    this does nothing.
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
                f"full_eval.py (process {file.read().strip() or 'not known'}), or a training that it has started, is "
                f"at work in {folder}; wait for it, stop it, or choose another --output_path"
            ) from error
        except OSError:
            yield
            return
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        os.set_inheritable(file.fileno(), True)
        yield
