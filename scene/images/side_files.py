"""Files beside photos, such as masks and depth maps: found, and written, below a folder by the photos' names.

A dataset may name a photo by an absolute path, or through parent folders. Such a name says where the photo is. It never
leads out of the folder of the side files.
"""

import filecmp
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from scene.images.find import FileIndex


def names_below(names: Sequence[str], base: Path) -> list[str]:
    """Names of photos as paths that stay below any folder, each name one path.

    They are the names themselves. If any is absolute or leads out of its folder, all are counted from the photos'
    common folder. base: folder that relative names count from.
    """
    names = [os.path.normpath(name).replace(os.sep, "/") for name in names]
    if not any(map(_leads_out, names)):
        return names
    paths = [os.path.abspath(base / name) for name in names]
    common = os.path.commonpath(list(map(os.path.dirname, paths)))
    return [os.path.relpath(path, common).replace(os.sep, "/") for path in paths]


def endings_of(names: Sequence[str]) -> list[list[str]]:
    """For each name its trailing parts, the longest first, of which no other name has the same up to the suffix."""
    parts = {name: ["/".join(name.split("/")[start:]) for start in range(name.count("/") + 1)] for name in names}
    counts = Counter(_stem(part) for own in parts.values() for part in own)
    return [[part for part in parts[name] if part == name or counts[_stem(part)] == 1] for name in names]


class SideFiles:
    """The files of one kind that lie in a folder beside the photos.

    A file is looked for by the photo's name as a path, then by ever shorter trailing parts of it, then by the bare name
    in any sub-folder. A part counts only if no other photo has it. A photo is no side file, nor is a copy of it.
    elsewhere: the files that only the bare name has found, by the photos' names. photos_met: photos that were found in
    place of side files.
    """

    def __init__(self, folder: Path, names: Sequence[str], photos: Sequence[str | Path], base: Path) -> None:
        """names, photos: of all photos, which must differ; their files may be missing. base: as for `names_below`."""
        self.elsewhere: dict[str, Path] = {}
        self.photos_met: set[Path] = set()
        self.names = names_below(names, base)
        self._endings, self._photos = endings_of(self.names), photos
        self._index = FileIndex(folder)
        self._identities = set(filter(None, map(identity, photos)))

    def find(self, place: int, spelled: Callable[[str], Iterable[str]]) -> Path | None:
        """The file of a photo, by its place in the list; None without one. spelled: file names for a photo's name."""
        endings = self._endings[place]
        for ending in endings:
            if found := self._index.find(*spelled(ending), but=lambda path: self._is_photo(path, place)):
                return found
        bare = endings[-1]
        if "/" in bare:
            return None
        alike = {path for name in spelled(bare) for path in self._index.named(name) if not self._is_photo(path, place)}
        if len(alike) != 1:
            return None
        (self.elsewhere[self.names[place]],) = alike
        return self.elsewhere[self.names[place]]

    def tell_elsewhere(self, kind: str) -> None:
        """Say which files were found by their bare names only. kind: plural, as "masks"."""
        if self.elsewhere:
            name, path = next(iter(self.elsewhere.items()))
            said = (
                f"{len(self.elsewhere)} {kind} lie in other sub-folders than their photos and are used by their names"
            )
            print(f"{said}; the first is {path} for {name}", file=sys.stderr)

    def _is_photo(self, path: Path, place: int) -> bool:
        own = self._photos[place]
        found = identity(path) in self._identities or (os.path.isfile(own) and filecmp.cmp(own, path, shallow=False))
        if found:
            self.photos_met.add(path)
        return found


def _leads_out(name: str) -> bool:
    return os.path.isabs(name) or name.split("/")[0] == os.pardir


def _stem(name: str) -> str:
    return os.path.splitext(name)[0].casefold()


def identity(path: str | Path | None) -> tuple[int, int] | None:
    """What tells a file from others, by whatever name; None where there is none."""
    try:
        info = os.stat(path or "")
    except OSError:
        return None
    return info.st_dev, info.st_ino
