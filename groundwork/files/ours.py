"""Pictures and folders that an export wrote beside its file: only these may be replaced or deleted.

A digest tells whether somebody else wrote or changed one. A picture has the digest in a comment, a folder in its name.
"""

import hashlib
import io
import os
import re
import zlib
from pathlib import Path

from PIL import Image

from groundwork.files.writing import atomic_write
from groundwork.host.errors import UserError

_DIGITS = 12  # of a folder's digest
_MARK = b"3D Gaussian Splatting, sha256 "


def is_ours(path: Path, owner: str = "") -> bool:
    """Tell whether a picture is unchanged since `write_picture`, or a folder has the digest of its files in its name.

    owner: name of the file that refers to the folder.
    """
    if path.is_symlink():
        return False
    if path.is_dir():
        named = re.fullmatch(rf"[a-z]+-([0-9a-f]{{{_DIGITS}}})", path.name)
        return bool(named) and named[1] == folder_digest(path, owner)
    if not path.is_file():
        return False
    content = path.read_bytes()
    start, size = _find_offset(content), len(_make_comment(content))
    return content == _insert_comment(content[:start] + content[start + size :])


def folder_digest(folder: Path, owner: str) -> str:
    """Hash the files below a folder, names and bytes. owner: name of the file that refers to the folder."""
    found = hashlib.sha256(os.fsencode(owner))
    for path in sorted_files(folder):
        name = path.relative_to(folder).as_posix()
        found.update(b"\0" + os.fsencode(name) + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:_DIGITS]


def sorted_files(folder: Path) -> list[Path]:
    """All files below a folder, sorted."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def refuse_foreign(path: Path) -> None:
    """Raise UserError if a picture would be written over something that is not ours."""
    if os.path.lexists(path) and not is_ours(path):
        raise UserError(
            f"no export wrote {path} as it is, and this one would replace it; move it, or choose another --to"
        )


def write_picture(path: Path, image: Image.Image, **options: object) -> None:
    """Write a JPEG or a PNG, whole or not at all. UserError if a file that is not ours has the name.

    options: passed to Pillow's writer.
    """
    refuse_foreign(path)
    content = io.BytesIO()
    image.save(content, "PNG" if path.suffix == ".png" else "JPEG", **options)
    with atomic_write(path) as temporary:
        temporary.write_bytes(_insert_comment(content.getvalue()))


def _insert_comment(picture: bytes) -> bytes:
    start = _find_offset(picture)
    return picture[:start] + _make_comment(picture) + picture[start:]


def _find_offset(picture: bytes) -> int:
    """The offset of the comment: behind the header of a PNG, or the start of a JPEG."""
    return 33 if picture.startswith(b"\x89PNG") else 2


def _make_comment(picture: bytes) -> bytes:
    """The comment, of one length for all pictures of a format."""
    text = _MARK + hashlib.sha256(picture).hexdigest().encode()
    if not picture.startswith(b"\x89PNG"):
        return b"\xff\xfe" + (2 + len(text)).to_bytes(2, "big") + text
    body = b"tEXtComment\0" + text
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
