"""Files that a user puts into `input`: what each one is, by its content, and why it is not used.

Photos keep the names that they have. A file that is no photo, such as a video or a sidecar, is left out and named. A
photo that cannot be read stops the conversion, since it may be a large part of the capture; the user may leave it out.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from groundwork.files.color_tags import HDR, code_points
from groundwork.files.image_files import HEIF_SUFFIXES, RAW_SUFFIXES, SUFFIXES, UNREADABLE, VIDEO_SUFFIXES, open_image
from groundwork.files.plain_files import describe_wrong_file, plain_path
from groundwork.host.listing import counted, some
from scene.images.decode import picture_size
from utils.system_utils import UserError

# Brands of ISO files.
_HEIF = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis")
_DNG_VERSION = 50706  # TIFF tag: a RAW file, whose first picture is a thumbnail
_VIDEO_STARTS = (b"\x1a\x45\xdf\xa3", b"\x00\x00\x01\xba")  # Matroska and WebM; MPEG program streams
# Formats whose files often lie beside a JPEG of the same shot.
_OFTEN_DOUBLE = ("HEIF", "AVIF", "RAW")
_INSTALL = "HEIC: `pip install '.[heic]'`, or export as JPEG"
_DEVELOP = "RAW: export as JPEG or TIFF"
_HDR = "HDR picture: export as SDR"
_DAMAGED = "damaged: copy it again"
_HUGE = "too large to be read: make it smaller"
_FLOAT = "floating-point pixels: save it with 8 or 16 bits"
_LINK = "a link to a folder or to nothing: copy the photos themselves"


class Inputs(NamedTuple):
    """The files of a folder. photos: names as COLMAP has them, sorted; unused: by name the reason."""

    photos: list[str]
    unused: dict[str, str]


def sort_inputs(folder: Path, skip_unreadable: bool = False, but: Iterable[Path] = (), below: bool = True) -> Inputs:
    """Tell the photos below a folder from its other files; hidden ones, and those of `but`, count as absent.

    skip_unreadable: leave out photos that cannot be read, also damaged ones; else a UserError names them by reason.
    below: look into sub-folders, too.
    """
    absent = {path.absolute() for path in but}
    paths = folder.rglob("*") if below else (path for path in folder.iterdir() if not path.is_dir())
    files = [path for path in sorted(paths) if path.is_file() or path.is_symlink()]
    seen = [path for path in files if not any(part.startswith(".") for part in path.relative_to(folder).parts)]
    kinds = {path: _kind(path, skip_unreadable) for path in seen if path.absolute() not in absent}
    stems = {path.with_suffix(""): path.name for path, kind in kinds.items() if kind.format not in (*_OFTEN_DOUBLE, "")}
    photos, unused, unreadable = [], {}, {}
    for path, kind in kinds.items():
        name = path.relative_to(folder).as_posix()
        if kind.format in _OFTEN_DOUBLE and (double := stems.get(path.with_suffix(""))):
            unused[name] = f"same name as {double}, which is used"
        elif not kind.reason:
            photos.append(name)
        elif kind.format and not skip_unreadable:
            unreadable.setdefault(kind.reason, []).append(name)
        else:
            unused[name] = kind.reason
    if unreadable:
        listed = "; ".join(f"{some(names)} ({reason})" for reason, names in unreadable.items())
        raise UserError(
            f"{counted(sum(map(len, unreadable.values())), 'photo')} in {folder} cannot be read: {listed}; follow "
            "these hints, or pass --skip_unreadable to convert.py, which leaves them out"
        )
    return Inputs(sorted(photos), unused)


def describe_unused(unused: dict[str, str]) -> list[str]:
    """One line for each reason, with names of files."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in unused.items():
        by_reason.setdefault(reason, []).append(name)
    return [f"not used: {some(names)} ({reason})" for reason, names in by_reason.items()]


class _Kind(NamedTuple):
    """Kind of a file. format: of a photo, else ""; reason: why the file cannot be used, or ""."""

    format: str
    reason: str


def _kind(path: Path, thorough: bool) -> _Kind:
    suffix = path.suffix.lower()
    if not path.is_file():
        return _Kind("unknown", _LINK)
    try:
        with open(plain_path(path), "rb") as file:
            head = file.read(16)
            brand = head[8:12] if head[4:8] == b"ftyp" else b""
    except OSError as error:
        return _Kind("unknown", f"{error.strerror}: make it readable")
    if suffix in RAW_SUFFIXES or brand == b"crx ":
        return _Kind("RAW", _DEVELOP)
    if brand in _HEIF:
        return _heif_kind(path, thorough)
    video = brand or head.startswith(_VIDEO_STARTS) or (head[:4], head[8:12]) == (b"RIFF", b"AVI ")
    if video or suffix in VIDEO_SUFFIXES:
        return _Kind("", "video: pass it as --video to take frames of it")
    return _picture_kind(path, thorough)


def _heif_kind(path: Path, thorough: bool) -> _Kind:
    """Return the kind of a HEIC or AVIF file, which share a container format."""
    if (points := code_points(plain_path(path), "HEIF")) and points[1] in HDR:
        return _Kind("HEIF", _HDR)
    if not _is_complete(path):
        return _Kind("HEIF", _DAMAGED)
    readable = _enable_heif()
    kind = _picture_kind(path, thorough)
    return _Kind("HEIF", _INSTALL) if kind.reason and not readable else kind


def _is_complete(path: Path) -> bool:
    """Tell if the boxes of an ISO file (ISO/IEC 14496-12) end where the file does."""
    place, size = 0, path.stat().st_size
    with open(path, "rb") as file:
        while place < size:
            file.seek(place)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            length = int.from_bytes(head[8:], "big") if length == 1 else length or size - place
            place += max(length, 8)
    return place == size


def _picture_kind(path: Path, thorough: bool) -> _Kind:
    suffix = path.suffix.lower()
    try:
        with open_image(path) as image:
            kind = image.format
            if image.mode == "F":
                return _Kind("unknown", _FLOAT)
            if kind == "TIFF" and _DNG_VERSION in image.tag_v2:
                return _Kind("RAW", _DEVELOP)
            if thorough:
                image.load()
        if kind == "TGA" and not _is_tga(path):
            return _Kind("", "no picture")
        if thorough:
            picture_size(path)
    except (Image.DecompressionBombError, MemoryError):
        return _Kind("unknown", _HUGE)
    except (*UNREADABLE, UserError):
        # Without `thorough`, the photos' own check says what is wrong with files that should be photos.
        if suffix in SUFFIXES:
            other = describe_wrong_file(path)
            return _Kind("unknown", (f"{other}: download it again" if other else _DAMAGED) if thorough else "")
        return _Kind("HEIF", _DAMAGED) if suffix in HEIF_SUFFIXES else _Kind("", "no picture")
    return _Kind("", "GIF, the format of animations") if kind == "GIF" else _Kind(kind, "")


def _is_tga(path: Path) -> bool:
    """Tell if a file that Pillow reads as TGA is one: the header has no mark, but newer files have one at the end."""
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - 26, 0))
        return path.suffix.lower() == ".tga" or file.read().startswith(b"TRUEVISION-XFILE")


def _enable_heif() -> bool:
    """Let Pillow read HEIC; return whether it can."""
    if "HEIF" not in Image.OPEN:
        try:
            import pillow_heif
        except ImportError:
            return False
        pillow_heif.register_heif_opener()
    return True
