"""Files and folders that this project wrote without being told their names: only these are replaced or deleted.

A digest tells them from others, also where somebody has changed them since. A picture has it in a comment, and a folder
in its name.
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
    """Whether a picture is as `write_picture` wrote it, or a folder has the digest of its files in its name.

    owner: as of `digest_of`.
    """
    if path.is_symlink():
        return False
    if path.is_dir():
        named = re.fullmatch(rf"[a-z]+-([0-9a-f]{{{_DIGITS}}})", path.name)
        return bool(named) and named[1] == digest_of(path, owner)
    if not path.is_file():
        return False
    content = path.read_bytes()
    start, size = _place(content), len(_chunk(content))
    return content == _marked(content[:start] + content[start + size :])


def digest_of(folder: Path, owner: str) -> str:
    """Of the files below a folder, by their names and bytes. owner: name of the file that refers to the folder."""
    found = hashlib.sha256(os.fsencode(owner))
    for path in files_of(folder):
        name = path.relative_to(folder).as_posix()
        found.update(b"\0" + os.fsencode(name) + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:_DIGITS]


def files_of(folder: Path) -> list[Path]:
    """All files below a folder, sorted."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def refuse_foreign(path: Path) -> None:
    """UserError for what has the name of a picture that will be written, and is not ours."""
    if os.path.lexists(path) and not is_ours(path):
        raise UserError(
            f"no export wrote {path} as it is, and this one would replace it; move it, or choose another --to"
        )


def write_picture(path: Path, image: Image.Image, **options: object) -> None:
    """Write a JPEG or a PNG, whole or not at all. UserError in place of a file that is not ours.

    options: of Pillow's writer.
    """
    refuse_foreign(path)
    content = io.BytesIO()
    image.save(content, "PNG" if path.suffix == ".png" else "JPEG", **options)
    with atomic_write(path) as temporary:
        temporary.write_bytes(_marked(content.getvalue()))


def _marked(picture: bytes) -> bytes:
    start = _place(picture)
    return picture[:start] + _chunk(picture) + picture[start:]


def _place(picture: bytes) -> int:
    """Where the comment stands: behind the header of a PNG, or the start of a JPEG."""
    return 33 if picture.startswith(b"\x89PNG") else 2


def _chunk(picture: bytes) -> bytes:
    """The comment, of one length for all pictures of a format."""
    text = _MARK + hashlib.sha256(picture).hexdigest().encode()
    if not picture.startswith(b"\x89PNG"):
        return b"\xff\xfe" + (2 + len(text)).to_bytes(2, "big") + text
    body = b"tEXtComment\0" + text
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
