"""Photos that share a camera in the reconstruction: those of one size and lens, unless the user says otherwise."""

from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from groundwork.host.progress import in_threads
from scene.images.decode import picture_size
from scene.images.exif import Lens, read_lens

MODES = ("per_lens", "per_folder", "per_photo", "shared")
_MOST_LISTED = 12


class Group(NamedTuple):
    """Photos that share a camera. size: width, height. lenses: what EXIF says of them, each once."""

    size: tuple[int, int]
    lenses: list[Lens]
    names: list[str]

    def __str__(self) -> str:
        said = f"{len(self.names)} {'photo' if len(self.names) == 1 else 'photos'}, {self.size[0]} x {self.size[1]}"
        folders = {str(PurePosixPath(name).parent) for name in self.names}
        place = f" in {folders.pop()}" if len(folders) == 1 and folders != {"."} else ""
        return f"{said}{place}: {' and '.join(map(str, self.lenses))}"


def read_lenses(folder: Path, names: Sequence[str]) -> dict[str, Lens]:
    """Read the lenses of photos below a folder, by name; a photo that is missing has none that is known."""
    return dict(zip(names, _read_all(read_lens, folder, names), strict=True))


def group_photos(folder: Path, names: Sequence[str], mode: str) -> list[Group]:
    """Divide photos below a folder by size and, as a mode of MODES says, by lens; in the order of first names.

    per_lens: a lens that EXIF does not name is taken for one lens for each sub-folder.
    """

    def key(name: str, lens: Lens) -> object:
        parent = PurePosixPath(name).parent
        apart = {"per_lens": (lens, None if lens.is_distinct else parent), "per_folder": parent, "per_photo": name}
        return apart.get(mode)

    groups: dict[object, Group] = {}
    sizes = _read_all(picture_size, folder, names)
    for (name, lens), size in zip(read_lenses(folder, names).items(), sizes, strict=True):
        found = groups.setdefault((size, key(name, lens)), Group(size, [], []))
        found.names.append(name)
        if lens not in found.lenses:
            found.lenses.append(lens)
    return list(groups.values())


def describe_groups(groups: Sequence[Group]) -> str:
    """Say which photos share a camera, a line for each."""
    if len(groups) == 1:
        return f"one camera for {groups[0]}"
    if all(len(one.names) == 1 for one in groups):
        return f"{len(groups)} cameras, one for each photo"
    lines = [f"  {one}" for one in groups[:_MOST_LISTED]]
    more = [f"  and {len(groups) - _MOST_LISTED} more"] if len(groups) > _MOST_LISTED else []
    return "\n".join([f"{len(groups)} cameras:", *lines, *more])


def describe_cameras(cameras: Sequence[dict[str, Any]], known: dict[str, Lens]) -> list[dict[str, Any]]:
    """Return the cameras of a model for the report, with their lenses' and photos' names."""
    found = []
    for camera in cameras:
        names = [*camera["photos"]]
        used = dict.fromkeys(str(known.get(name, Lens())) for name in names)
        found.append({**camera, "lenses": [*used], "photos": names, "registered": len(names)})
    return found


def _read_all(read: Callable[[Path], Any], folder: Path, names: Sequence[str]) -> list[Any]:
    return in_threads(lambda name: read(folder / name), names, disable=True)
