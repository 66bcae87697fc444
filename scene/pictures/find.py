"""Files that a dataset names, looked for on disk."""

import os
import sys
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from utils.files.listing import some
from utils.system_utils import UserError


class FileIndex:
    """Finds files below a folder by name, and where the exact one is missing by one that differs in letter case, in
    the way accents are encoded (as between macOS and Linux), or in the kind of slash.

    merely_alike: the names whose file is not the exact one, and that file.
    """

    def __init__(self, folder: Path) -> None:
        self.merely_alike: dict[str, Path] = {}
        self._folder = folder
        self._folded_paths: dict[str, list[Path]] | None = None  # not before the first miss: a large folder takes time

    def find(self, *names: str) -> Path | None:
        """The file of the first of these names that has one. None also where several files are alike, none exact."""
        for name in names:
            # os.path, not Path.is_file: a name that is too long for the system is missing too.
            if os.path.isfile(exact := self._folder / name):
                return exact
        if self._folded_paths is None:
            self._folded_paths = {}
            for folder, _, files in os.walk(self._folder):
                for path in (Path(folder, file) for file in files):
                    self._folded_paths.setdefault(_folded(str(path.relative_to(self._folder))), []).append(path)
        for name in names:
            alike = self._folded_paths.get(_folded(name), [])
            if len(alike) == 1:
                self.merely_alike[name] = alike[0]
                return alike[0]
        return None

    def with_another_suffix(self, name: str) -> Path | None:
        """A file of this name but for what follows its last dot, after a miss: the same picture in another format."""
        stem = os.path.splitext(_folded(name))[0]
        alike = (
            paths[0] for folded, paths in (self._folded_paths or {}).items() if os.path.splitext(folded)[0] == stem
        )
        return next(alike, None)


def _folded(name: str) -> str:
    name = unicodedata.normalize("NFC", os.path.normpath(name.replace("\\", "/"))).casefold()
    return name.replace(os.sep, "/")


def find_pictures(
    folder: Path, names: Sequence[str], listed_by: str, remedy: str, suffixes: Sequence[str] = ()
) -> list[Path]:
    """The files of pictures by their names in a folder. A line says when some are found under a name merely alike.

    suffixes: may be missing in the names. UserError with the missing files; listed_by and remedy are parts of it.
    """
    if names and not folder.is_dir():
        raise UserError(f"there is no folder {folder}, where {listed_by} has its pictures; {remedy}")
    index = FileIndex(folder)
    paths = [index.find(name, *(name + suffix for suffix in suffixes)) for name in names]
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing:
        if suffixes:
            missing = [name if name.lower().endswith(tuple(suffixes)) else name + suffixes[0] for name in missing]
        other = index.with_another_suffix(missing[0])
        instead = f" ({other.relative_to(folder)} is there instead)" if other else ""
        raise UserError(
            f"{len(missing)} of {len(paths)} pictures that {listed_by} lists are missing: "
            f"{some([str(folder / name) for name in missing])}{instead}; {remedy}"
        )
    if index.merely_alike:
        name, path = next(iter(index.merely_alike.items()))
        print(
            f"{len(index.merely_alike)} of {len(paths)} pictures have other letters in their file names than in "
            f"{listed_by}, the first is {path.relative_to(folder)} for {name}; they are used",
            file=sys.stderr,
        )
    return paths
