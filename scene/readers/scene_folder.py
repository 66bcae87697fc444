"""Kinds of dataset folders, and hints at the right folder for a user who gave another one."""

import os
import shlex
from pathlib import Path

from scene.readers.metashape import cameras_xml
from scene.readers.phone_scans import polycam_capture, record3d_capture
from splatting.host.listing import some
from splatting.host.start import typed_command
from utils.system_utils import UserError

COLMAP, BLENDER, NERFSTUDIO = "Colmap", "Blender", "Nerfstudio"
_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
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
        raise UserError(f"{folder} is a file; give -s the folder of the scene{_or_rather(_above(folder.parent))}")
    kind = _kind(folder)
    if kind is None:
        found = sorted(path.name for path in folder.iterdir())
        raise UserError(
            f"{folder} is not a scene: looked for the folder sparse (COLMAP), the files transforms_train.json "
            "(Blender) and transforms.json (nerfstudio), and exports of Metashape, Polycam and Record3D, found "
            f"{some(found)}; {_remedy(folder)}"
        )
    return kind


def is_scene(folder: str | os.PathLike) -> bool:
    """Whether a folder has cameras of one of the kinds."""
    return _kind(Path(folder)) is not None


def is_apart(folder: Path) -> bool:
    """Whether a folder is no scene and no model, has no scene in it, and lies in none."""
    inner = any(path.is_dir() and _kind(path) for path in folder.iterdir())
    return not (inner or _above(folder) or (folder / "cfg_args").is_file())


def _kind(folder: Path) -> str | None:
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


def _remedy(folder: Path) -> str:
    if (folder / "cfg_args").is_file():
        return "it is a model that train.py wrote: give it as -m, and its scene as -s"
    below = sorted(path for path in folder.iterdir() if path.is_dir() and _kind(path))
    if below:
        return f"give -s a scene in it: {some(list(map(str, below)))}"
    if above := _above(folder):
        return f"give -s {above}, which is a scene"
    if any((folder / name).is_file() for name in _MODEL):
        return "the files of a COLMAP model belong in a folder sparse/0 of the scene, beside the folder images"
    if packed := sorted(path.name for path in folder.iterdir() if path.suffix.lower() in _PACKED):
        return f"unpack {some(packed)}{_ZIP}, and give -s the folder that comes out"
    inner = [path for path in (folder / "input", folder / "images", folder) if path.is_dir() and _has_pictures(path)]
    if inner and inner[0].name == "input":
        return f"photos need camera poses: run {typed_command('convert.py')} -s {shlex.quote(str(folder))} first"
    if inner:
        command = f"{typed_command('convert.py')} -s {shlex.quote(str(folder))}"
        return f"photos need camera poses: put them into a folder {folder / 'input'} and run {command} first"
    return "give -s the folder that holds one of them"


def _above(folder: Path) -> Path | None:
    """The scene that contains this folder, at most two levels up, as for images/left or sparse/0."""
    return next((path for path in (folder, *folder.absolute().parents[:2]) if _kind(path)), None)


def _or_rather(scene: Path | None) -> str:
    return f", {scene}" if scene else ""


def _has_pictures(folder: Path) -> bool:
    # No deeper: the folder may be any on the disk.
    return any(path.suffix.lower() in _PICTURES for pattern in ("*", "*/*") for path in folder.glob(pattern))
