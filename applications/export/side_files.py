"""A JSON file with a folder of further files beside it, written whole or not at all."""

import contextlib
import filecmp
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from groundwork.files.json_files import read_json
from groundwork.files.ours import folder_digest, is_ours, sorted_files
from utils.system_utils import atomic_write, mkdir_p

PLACE = "{folder}"  # stands for the name of the folder


@contextlib.contextmanager
def write_with_folder(path: Path, prefix: str) -> Iterator[Path]:
    """Yield a folder for files; afterwards the JSON file `path` beside it names them where they then are.

    The block puts the JSON file into the folder, too, under the name of `path`, with PLACE for the folder's name, which
    asset.extras.folder also has. That name is `prefix` and a digest of its files and of the name of `path`. Where there
    is such a folder already, files that lack or differ are replaced. An earlier JSON file of ours stays valid until the
    new one takes its place; then its folder goes, if it is as we wrote it, and no other JSON file beside it names it.
    """
    earlier = _find_folder(path)
    with contextlib.ExitStack() as stack:
        temporary = stack.enter_context(atomic_write(path))
        holder = tempfile.TemporaryDirectory(prefix=".tiles.", suffix=".tmp", dir=path.parent)
        folder = Path(stack.enter_context(holder)) / "files"
        mkdir_p(folder)  # with the permissions that folders have, unlike its holder
        yield folder
        text = (folder / path.name).read_text(encoding="utf-8")
        (folder / path.name).unlink()
        final = path.parent / (prefix + folder_digest(folder, path.name))
        temporary.write_text(text.replace(PLACE, final.name), encoding="utf-8")
        _put_folder(folder, final)
    if earlier and earlier != final:
        _remove_folder(earlier, path)


def _put_folder(folder: Path, final: Path) -> None:
    """Rename a folder; or bring its files into one that is there, of which some may be damaged."""
    if not final.exists():
        os.replace(folder, final)
        return
    for file in sorted_files(folder):
        target = final / file.relative_to(folder)
        if not (target.is_file() and filecmp.cmp(file, target, shallow=False)):
            mkdir_p(target.parent)
            os.replace(file, target)


def _find_folder(path: Path) -> Path | None:
    """The folder that an earlier file names; None without one."""
    try:
        name = read_json(path)["asset"]["extras"]["folder"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    there = isinstance(name, str) and Path(name).name == name and (path.parent / name).is_dir()
    return path.parent / name if there else None


def _remove_folder(folder: Path, path: Path) -> None:
    """Remove the folder of an earlier `path`; say so if it stays."""
    others = (file for file in path.parent.iterdir() if file.suffix.lower() == ".json" and file.is_file())
    if not is_ours(folder, path.name):
        reason = "was not written by an export for this file, or has changed since"
    elif named := next((file.name for file in others if os.fsencode(folder.name) in file.read_bytes()), None):
        reason = f"is named by {named}"
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return
    print(f"warning: the folder {folder} of the earlier {path.name} stays, as it {reason}", file=sys.stderr)
