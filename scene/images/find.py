"""Search for the files that a dataset names, and for those beside its photos, such as masks and depth maps.

Files beside photos are found, and written, below a folder by the photos' names. A dataset may name a photo by an
absolute path, or through parent folders; such a name never leads out of the folder of the side files.
"""

import filecmp
import os
import sys
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from groundwork.files.image_files import SUFFIXES
from groundwork.host.listing import some
from scene.images.decode import picture_size
from utils.system_utils import UserError


class FileIndex:
    """Files below a folder, found by name.

    If the exact name is missing, a similar one is accepted: it may differ in letter case, in the encoding of accents
    (as between macOS and Linux), or in the kind of slash. merely_alike: names found that way, with their files.
    """

    def __init__(self, folder: Path) -> None:
        self.merely_alike: dict[str, Path] = {}
        self._folder = folder

    def find(self, *names: str, skip: Callable[[Path], bool] = lambda path: False) -> Path | None:
        """Find the file of the first name that has one; None if none has, or if several files match but none exactly.

        skip: returns True for a file that must not be found.
        """
        for name in names:
            # Path.is_file raises an error for a name that is too long for the system; here it counts as missing.
            if os.path.isfile(exact := self._folder / name) and not skip(exact):
                return exact
        for name in names:
            alike = self._folded.get(_fold_name(name), [])
            if len(alike) == 1 and not skip(alike[0]):
                self.merely_alike[name] = alike[0]
                return alike[0]
        return None

    @cached_property
    def _folded(self) -> dict[str, list[Path]]:
        """Files by folded name, made at the first miss: a large folder takes time."""
        found: dict[str, list[Path]] = {}
        for path in files_below(self._folder):
            found.setdefault(_fold_name(str(path.relative_to(self._folder))), []).append(path)
        return found

    @cached_property
    def _bare(self) -> dict[str, list[Path]]:
        found: dict[str, list[Path]] = {}
        for folded, paths in self._folded.items():
            found.setdefault(folded.rpartition("/")[2], []).extend(paths)
        return found

    def named(self, name: str) -> list[Path]:
        """All files of a bare name, in any sub-folder."""
        return self._bare.get(_fold_name(name), [])

    def with_another_suffix(self, name: str) -> list[Path]:
        """Images of this name with another suffix, likely the same photo in another format."""
        stem = os.path.splitext(_fold_name(name))[0]
        return [path for suffix in SUFFIXES for path in self._folded.get(stem + suffix, [])]

    def description(self) -> str:
        """The contents of the folder, in brackets, for messages."""
        there = sorted(str(path.relative_to(self._folder)) for paths in self._folded.values() for path in paths)
        return f" (the folder has {some(there)})" if there else " (the folder is empty)"


def files_below(folder: Path) -> Iterator[Path]:
    """Files in a folder and below it, also behind links; a link to a folder that it lies in is not followed."""
    for here, folders, files in os.walk(folder, followlinks=True):
        above = {identity(parent) for parent in (here, *Path(here).absolute().parents)}
        folders[:] = [name for name in folders if identity(os.path.join(here, name)) not in above]
        # A pipe is no file, and whoever opens one waits for ever; a link may lead to nothing.
        yield from (Path(here, file) for file in files if os.path.isfile(os.path.join(here, file)))


def _fold_name(name: str) -> str:
    name = unicodedata.normalize("NFC", os.path.normpath(name.replace("\\", "/"))).casefold()
    return name.replace(os.sep, "/")


def _describe_broken(paths: Sequence[Path | None]) -> str:
    """Words on the files that are there and cannot be read, so that one message tells of all; empty without any."""
    broken = []
    for path in paths:
        try:
            path and picture_size(path)
        except UserError:
            broken.append(str(path))
    return f", and {len(broken)} cannot be read: {some(broken)}" if broken else ""


def find_images(
    folder: Path, names: Sequence[str], listed_by: str, remedy: str, suffixes: Sequence[str] = (), kind: str = "photos"
) -> list[Path]:
    """The files of photos by their names in a folder. A message says when some were found by a merely similar name.

    suffixes: a name may lack one of these. UserError naming the missing files; listed_by, remedy and kind (plural) are
    parts of the messages.
    """
    if names and not folder.is_dir():
        raise UserError(f"there is no folder {folder}, where {listed_by} has its {kind}; {remedy}")
    paths, others = find_listed(index := FileIndex(folder), names, suffixes)
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing:
        if suffixes:
            missing = [name if name.lower().endswith(tuple(suffixes)) else name + suffixes[0] for name in missing]
        instead = index.description()
        if os.path.lexists(folder / missing[0]):
            instead = " (a broken link, or not a file)"
        raise UserError(
            f"{len(missing)} of {len(paths)} {kind} that {listed_by} lists are missing: "
            f"{some([str(folder / name) for name in missing])}{instead}{_describe_broken(paths)}; {remedy}"
        )
    for changed, difference in ((others, "have another suffix than"), (index.merely_alike, "differ slightly from")):
        if changed:
            name, path = next(iter(changed.items()))
            print(
                f"{len(changed)} of {len(paths)} {kind} are matched to files whose names {difference} those in "
                f"{listed_by}; the first is {os.path.relpath(path, folder)} for {name}",
                file=sys.stderr,
            )
    return paths


def find_listed(
    index: FileIndex, names: Sequence[str], suffixes: Sequence[str]
) -> tuple[list[Path | None], dict[str, Path]]:
    """The files of photos as `find_images` finds them, None without one; and those with another suffix, by name."""
    paths = [index.find(name, *(name + suffix for suffix in suffixes)) for name in names]
    others = _find_converted(index, names, paths)
    return [others.get(name, path) for name, path in zip(names, paths, strict=True)], others


def other_folder(file: Path, names: Sequence[str], images: str, suffixes: Sequence[str]) -> Path | None:
    """The folder of photos that a camera file names otherwise: the one that is given, or one that has all of them.

    None where photos lie as the file names them, or nowhere. images: as given by -i; empty or "images": not given. A
    message says which folder is taken. UserError where a given one lacks photos.
    """
    base = file.parent
    if images not in ("", "images"):
        lacking = [name for name, path in zip(names, find_in(base / images, names, suffixes), strict=True) if not path]
        if lacking:
            raise UserError(
                f"{len(lacking)} of {len(names)} photos that {file} lists are not in the folder of -i {images}: "
                f"{some(lacking)}; name the folder that has them, or leave -i out"
            )
        return base / images
    if None not in find_listed(FileIndex(base), names, suffixes)[0]:
        return None
    top = os.path.dirname(os.path.commonprefix([os.path.normpath(name) for name in names])) or "images"
    for other in (f"{top}_2", f"{top}_4", f"{top}_8", "images", "../resized_images", "../images"):
        if (base / other).is_dir() and None not in find_in(base / other, names, suffixes):
            print(f"the photos are not where {file} says, so those in {base / other} are used", file=sys.stderr)
            return base / other
    return None


def find_in(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> list[Path | None]:
    """The files of photos in another folder than the one named, as `SideFiles` finds them."""
    files = SideFiles(folder, names, [""] * len(names), folder)
    return [files.find(place, lambda name: (name, *(name + one for one in suffixes))) for place in range(len(names))]


def _find_converted(index: FileIndex, names: Sequence[str], paths: Sequence[Path | None]) -> dict[str, Path]:
    """Find the files of missing photos that were converted to another format, by the photos' names.

    paths: the files that were found for `names`, None: missing. A file counts if only its suffix differs from the name,
    it is the only such file, and no other photo has it.
    """
    missing = {name for name, path in zip(names, paths, strict=True) if path is None}
    if not missing:
        return {}
    found = {name: index.with_another_suffix(name) for name in missing}
    taken = Counter(path for alike in [*found.values(), filter(None, paths)] for path in alike)
    return {name: found[name][0] for name in names if name in missing and _is_only(found[name], taken)}


def _is_only(alike: Sequence[Path], taken: Mapping[Path, int]) -> bool:
    return len(alike) == 1 and taken[alike[0]] == 1


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
    counts = Counter(_fold_stem(part) for own in parts.values() for part in own)
    return [[part for part in parts[name] if part == name or counts[_fold_stem(part)] == 1] for name in names]


class SideFiles:
    """The files of one kind that lie in a folder beside the photos.

    A file is looked for by the photo's name as a path, then by ever shorter trailing parts of it, then by the bare name
    in any sub-folder. A part counts only if no other photo has it. A photo is no side file, nor is a copy of it.
    elsewhere: the files that only the bare name has found, by the photos' names. photos_met: photos that were found in
    place of side files.
    """

    def __init__(self, folder: Path, names: Sequence[str], photos: Sequence[str | Path], base: Path) -> None:
        """names, photos: of all photos, which must differ; the files may be missing. base: folder of relative names."""
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
            if found := self._index.find(*spelled(ending), skip=lambda path: self._is_photo(path, place)):
                return found
        bare = endings[-1]
        if "/" in bare:
            return None
        alike = {path for name in spelled(bare) for path in self._index.named(name) if not self._is_photo(path, place)}
        if len(alike) != 1:
            return None
        (self.elsewhere[self.names[place]],) = alike
        return self.elsewhere[self.names[place]]

    def report_elsewhere(self, kind: str) -> None:
        """Say which files were found by their bare names only. kind: plural, as "masks"."""
        if self.elsewhere:
            name, path = next(iter(self.elsewhere.items()))
            said = (
                f"{len(self.elsewhere)} {kind} lie in other sub-folders than their photos and are used by their names"
            )
            print(f"{said}; the first is {path} for {name}", file=sys.stderr)

    def _is_photo(self, path: Path, place: int) -> bool:
        """Tell whether a file is a photo of the dataset, or a copy of the photo at `place` of the list."""
        own = self._photos[place]
        found = identity(path) in self._identities or (os.path.isfile(own) and filecmp.cmp(own, path, shallow=False))
        if found:
            self.photos_met.add(path)
        return found


def _leads_out(name: str) -> bool:
    return os.path.isabs(name) or name.split("/")[0] == os.pardir


def _fold_stem(name: str) -> str:
    return os.path.splitext(name)[0].casefold()


def identity(path: str | Path | None) -> tuple[int, int] | None:
    """The identity of a file under any name; None if the file is missing."""
    try:
        info = os.stat(path or "")
    except OSError:
        return None
    return info.st_dev, info.st_ino
