"""Files and folders that are written whole or not at all."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from groundwork.host.errors import UserError
from groundwork.ranks.ranks import ranks


def writes_files() -> bool:
    """Tell whether this process writes a training's files: with several ranks, only the first one does."""
    return ranks().first


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, every_rank: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with its suffix; rename it to `path` if the block succeeds, else delete it.

    Creates a missing folder. A killed process may leave the hidden temporary file, but never half a `path`. An OSError
    of the block or of renaming (disk full, `path` is a folder) becomes a UserError. With several ranks, files of others
    than the first are dropped. every_rank: each rank writes, as into a cache.
    """
    if not (every_rank or writes_files()):
        yield Path(os.devnull)
        return
    target = Path(path)
    mkdir_p(target.parent)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            reason = error.strerror or error
            raise UserError(
                f"cannot write {target} ({reason}); free space, fix the permissions, or choose another place"
            ) from error
        raise


def mkdir_p(folder_path: str | os.PathLike) -> None:
    """Create a folder and its parents; an existing folder is fine. UserError when the system refuses."""
    try:
        os.makedirs(folder_path, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"cannot create the folder {folder_path} ({error.strerror}); choose another place, or fix its permissions"
        ) from error


def check_folder_can_be_made(folder: str | os.PathLike) -> None:
    """UserError where `mkdir_p` would raise one. Leaves no folder that was not there."""
    made = [path for path in (Path(folder), *Path(folder).parents) if not path.exists()]
    try:
        mkdir_p(folder)
    finally:
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a folder for temporary files, and delete it afterwards. UserError where none can be made."""
    try:
        folder = tempfile.TemporaryDirectory()
    except OSError as error:
        raise UserError(
            f"cannot make a temporary folder ({error}); free space there, or name another place in the environment "
            "variable TMPDIR"
        ) from error
    with folder as name:
        yield Path(name)
