"""Kinds of dataset folders, and hints at the right folder for a user who gave another one."""

import os
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from groundwork.files.image_files import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from groundwork.files.json_files import read_json
from groundwork.host.listing import some
from groundwork.host.start import typed_command
from scene.readers.metashape import cameras_xml
from scene.readers.phone_scans import polycam_capture, record3d_capture
from utils.system_utils import UserError

COLMAP, BLENDER, NERFSTUDIO = "Colmap", "Blender", "Nerfstudio"
REPORT = "convert_report.json"  # of a scene that convert.py made
WORK = "distorted"  # of a conversion, whose models are no scene
FEWEST = 3  # photos that are converted
_PACKED = (".zip", ".r3d")  # as apps export them
_ZIP = " (.r3d is ZIP by another name)"
_MODEL = ("cameras.bin", "cameras.txt")


def kind_of(source_path: str | os.PathLike) -> str:
    """COLMAP, BLENDER or NERFSTUDIO. UserError saying what was looked for and found, and where the scene may be."""
    if not str(source_path):
        raise UserError("no scene folder given; name it with -s")
    folder = Path(source_path)
    if not folder.exists():
        raise UserError(f"no scene folder {folder}; name an existing one with -s")
    if folder.suffix.lower() in _PACKED and folder.is_file():
        raise UserError(
            f"{folder} is an archive (a .r3d is a ZIP, too); unpack it, and give -s the folder that comes out"
        )
    if not folder.is_dir():
        raise UserError(f"{folder} is a file; give -s the folder of the scene{_hint_scene(scene_above(folder.parent))}")
    kind = _find_kind(folder)
    if kind is None:
        found = sorted(path.name for path in folder.iterdir())
        raise UserError(
            f"{folder} is not a scene: looked for the folder sparse (COLMAP), the files transforms_train.json "
            "(Blender) and transforms.json (nerfstudio), and exports of Metashape, Polycam and Record3D, found "
            f"{some(found)}; {_find_remedy(folder)}"
        )
    return kind


def is_scene(folder: str | os.PathLike) -> bool:
    """Tell whether a folder has cameras of one of the kinds."""
    return _find_kind(Path(folder)) is not None


def describe_verdict(folder: str | os.PathLike) -> str:
    """Say why convert.py would not train on a scene that it made; "" if it would, or did not make the scene."""
    try:
        verdict = read_json(Path(folder) / REPORT).get("unusable")
    except (OSError, ValueError, AttributeError):
        return ""
    return f"convert.py says of this scene: {verdict}" if verdict else ""


def is_unrelated(folder: Path) -> bool:
    """Tell whether a folder is no scene and no model, has no scene in it, and is in none."""
    return not (_find_scenes(folder) or scene_above(folder) or (folder / "cfg_args").is_file())


class Capture(NamedTuple):
    """Photos and videos of a folder, where they lie (`input` or the folder itself), and photos in the folder itself."""

    place: Path
    photos: list[Path]
    videos: list[Path]
    beside: list[Path]

    @property
    def is_video(self) -> bool:
        """True if the videos are the larger kind, or the photos are too few."""
        photos, videos = (sum(path.stat().st_size for path in paths) for paths in (self.photos, self.videos))
        return bool(self.videos) and (len(self.photos) < FEWEST or videos > photos)


def find_capture(folder: Path) -> Capture:
    """Find the photos and videos of a folder by their names, without hidden ones and the videos of Live Photos."""
    place = folder / "input"
    here, inner = _list_visible(folder, folder.glob("*")), _list_visible(place, place.rglob("*"))
    photos = [path for path in inner or here if path.suffix.lower() in PHOTO_SUFFIXES]
    stills = {path.with_suffix("") for path in photos} if len(photos) >= FEWEST else set()
    videos = [path for path in inner or here if path.suffix.lower() in VIDEO_SUFFIXES]
    videos = [path for path in videos if path.with_suffix("") not in stills]
    beside = [path for path in here if path.suffix.lower() in PHOTO_SUFFIXES]
    return Capture(place if inner else folder, photos, videos, beside)


def _list_visible(folder: Path, paths: Iterable[Path]) -> list[Path]:
    """The files among the paths below a folder, sorted, without hidden ones and those in hidden folders."""
    seen = (path for path in paths if not any(part.startswith(".") for part in path.relative_to(folder).parts))
    return sorted(path for path in seen if path.is_file())


def how_to_convert(folder: Path) -> str:
    """Say how the photos or videos of a folder get cameras; "" if there are none."""
    found, command = find_capture(folder), f"{typed_command('convert.py')} -s {shlex.quote(str(folder))}"
    if found.is_video:
        return f"run {command} --video {shlex.join(map(str, found.videos))}"
    if found.photos:
        return f"run {command}"
    folders = (path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    inner = sorted(path.name for path in folders if _has_pictures(path))
    which = inner[0] if len(inner) == 1 else f"of photos ({some(inner)})"
    return f"rename its folder {which} to input and run {command}" if inner else ""


def _find_kind(folder: Path) -> str | None:
    """Return the kind of scene in a folder: COLMAP, BLENDER or NERFSTUDIO; None for another folder."""
    if (folder / "sparse").is_dir():
        return COLMAP
    if (folder / "transforms_train.json").is_file():
        return BLENDER
    return NERFSTUDIO if camera_file(folder) else None


def camera_file(folder: Path) -> Path | None:
    """transforms.json of a folder, else what another program has exported in its place; None where there is neither."""
    path = folder / "transforms.json"
    if path.is_file():
        return path
    return polycam_capture(folder) or record3d_capture(folder) or cameras_xml(folder)


def _find_remedy(folder: Path) -> str:
    """Return the advice for a folder that is no scene, by its contents."""
    if (folder / "cfg_args").is_file():
        return "it is a model that train.py wrote: give it as -m, and its scene as -s"
    if below := _find_scenes(folder):
        return f"give -s a scene in it: {some(list(map(str, below)))}"
    if above := scene_above(folder):
        return f"give -s {above}, which is a scene"
    if any((folder / name).is_file() for name in _MODEL):
        return "the files of a COLMAP model belong in a folder sparse/0 of the scene, beside the folder images"
    if packed := sorted(path.name for path in folder.iterdir() if path.suffix.lower() in _PACKED):
        return f"unpack {some(packed)}{_ZIP}, and give -s the folder that comes out"
    if command := how_to_convert(folder):
        return f"photos need camera poses: {command} first"
    return "give -s the folder that holds one of them"


def _find_scenes(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and path.name != WORK and _find_kind(path))


def scene_above(folder: Path) -> Path | None:
    """The scene that contains this folder, at most two levels up, as for images/left or sparse/0."""
    return next((path for path in (folder, *folder.absolute().parents[:2]) if _find_kind(path)), None)


def _hint_scene(scene: Path | None) -> str:
    return f", {scene}" if scene else ""


def _has_pictures(folder: Path) -> bool:
    # No deeper: the folder may be any on the disk.
    return any(path.suffix.lower() in PHOTO_SUFFIXES for pattern in ("*", "*/*") for path in folder.glob(pattern))
