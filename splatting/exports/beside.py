"""A file with a folder of further files beside it, written whole or not at all."""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from utils.system_utils import atomic_write, mkdir_p

PLACE = "{folder}"  # stands for the name of the folder


@contextlib.contextmanager
def with_folder(path: Path, prefix: str) -> Iterator[Path]:
    """Yield a folder for files; afterwards the JSON file `path` beside it names them where they then are.

    The block puts the JSON file into the folder, too, under the name of `path`, with PLACE for the folder's name, which
    asset.extras.folder also has. That name is `prefix` and a digest of its files. An earlier JSON file of ours stays
    valid until the new one takes its place; then its folder goes.
    """
    earlier = _folder_of(path, prefix)
    with contextlib.ExitStack() as stack:
        temporary = stack.enter_context(atomic_write(path))
        folder = stack.enter_context(_new_folder(path.parent))
        yield folder
        text = (folder / path.name).read_text(encoding="utf-8")
        (folder / path.name).unlink()
        final = path.parent / (prefix + _digest(folder))
        temporary.write_text(text.replace(PLACE, final.name), encoding="utf-8")
        if not final.exists():  # else these are the same files
            os.replace(folder, final)
    if earlier and earlier != final:
        shutil.rmtree(earlier, ignore_errors=True)


@contextlib.contextmanager
def _new_folder(parent: Path) -> Iterator[Path]:
    """A hidden folder, which is deleted at the end unless it has another name by then."""
    folder = parent / f".tiles.{os.getpid()}.tmp"
    mkdir_p(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _digest(folder: Path) -> str:
    """A name for the files below a folder, by their names and bytes."""
    found = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        found.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:12]


def _folder_of(path: Path, prefix: str) -> Path | None:
    """The folder of an earlier file that export.py wrote; None without one."""
    try:
        name = json.loads(path.read_text(encoding="utf-8"))["asset"]["extras"]["folder"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    known = isinstance(name, str) and name.startswith(prefix) and Path(name).name == name
    return path.parent / name if known else None
