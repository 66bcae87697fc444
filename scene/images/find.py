"""Search for the files that a dataset names."""

import os
import sys
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from splatting.files.listing import some
from utils.system_utils import UserError


class FileIndex:
    """Files below a folder, found by name.

    If the exact name is missing, a similar one is accepted: it may differ in letter case, in the encoding of accents
    (as between macOS and Linux), or in the kind of slash. merely_alike: names found that way, with their files.
    """

    def __init__(self, folder: Path) -> None:
        self.merely_alike: dict[str, Path] = {}
        self._folder = folder
        self._folded_paths: dict[str, list[Path]] | None = None  # built at the first miss: a large folder takes time

    def find(self, *names: str) -> Path | None:
        """The file of the first name that has one; None if none has, or if several files match but none exactly."""
        for name in names:
            # Path.is_file raises an error for a name that is too long for the system; here it counts as missing.
            if os.path.isfile(exact := self._folder / name):
                return exact
        if self._folded_paths is None:
            self._folded_paths = {}
            for folder, _, files in os.walk(self._folder):
                # A pipe is no file, and whoever opens one waits for ever; a link may lead to nothing.
                for path in (Path(folder, file) for file in files if os.path.isfile(os.path.join(folder, file))):
                    self._folded_paths.setdefault(_folded(str(path.relative_to(self._folder))), []).append(path)
        for name in names:
            alike = self._folded_paths.get(_folded(name), [])
            if len(alike) == 1:
                self.merely_alike[name] = alike[0]
                return alike[0]
        return None

    def with_another_suffix(self, name: str) -> Path | None:
        """After a miss: a file of this name with another suffix, likely the same photo in another format."""
        stem = os.path.splitext(_folded(name))[0]
        alike = (
            paths[0] for folded, paths in (self._folded_paths or {}).items() if os.path.splitext(folded)[0] == stem
        )
        return next(alike, None)

    def description(self) -> str:
        """After a miss: what the folder has, in brackets."""
        there = sorted(str(path.relative_to(self._folder)) for paths in self._folded_paths.values() for path in paths)
        return f" (the folder has {some(there)})" if there else " (the folder is empty)"


def _folded(name: str) -> str:
    name = unicodedata.normalize("NFC", os.path.normpath(name.replace("\\", "/"))).casefold()
    return name.replace(os.sep, "/")


def find_images(
    folder: Path, names: Sequence[str], listed_by: str, remedy: str, suffixes: Sequence[str] = (), kind: str = "photos"
) -> list[Path]:
    """The files of photos by their names in a folder. A message says when some were found by a merely similar name.

    suffixes: a name may lack one of these. UserError naming the missing files; listed_by, remedy and kind (plural) are
    parts of the messages.
    """
    if names and not folder.is_dir():
        raise UserError(f"there is no folder {folder}, where {listed_by} has its {kind}; {remedy}")
    index = FileIndex(folder)
    paths = [index.find(name, *(name + suffix for suffix in suffixes)) for name in names]
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing:
        if suffixes:
            missing = [name if name.lower().endswith(tuple(suffixes)) else name + suffixes[0] for name in missing]
        other = index.with_another_suffix(missing[0])
        if other:
            instead = f" ({other.relative_to(folder)} is there instead)"
        else:
            instead = index.description()
            if os.path.lexists(folder / missing[0]):
                instead = " (it is there, but a link to nothing or no file)"
        raise UserError(
            f"{len(missing)} of {len(paths)} {kind} that {listed_by} lists are missing: "
            f"{some([str(folder / name) for name in missing])}{instead}; {remedy}"
        )
    if index.merely_alike:
        name, path = next(iter(index.merely_alike.items()))
        print(
            f"{len(index.merely_alike)} of {len(paths)} {kind} are used although their file names differ slightly "
            f"from those in {listed_by}; the first is {path.relative_to(folder)} for {name}",
            file=sys.stderr,
        )
    return paths
