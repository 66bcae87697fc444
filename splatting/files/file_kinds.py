"""Detection of files whose content is not what their name says, after a failed download or clone."""

import os

from splatting.files.plain_files import plain

_HEAD = 256


def not_the_file(path: str | os.PathLike) -> str | None:
    """Words for a file that is empty, a Git LFS pointer or a web page; None for any other file."""
    try:
        with open(plain(path), "rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return None
    if not head:
        return "empty"
    if head.startswith(b"version https://git-lfs"):
        return "a Git LFS pointer (git lfs pull downloads its content)"
    if head.lstrip()[:9].lower().startswith((b"<!doctype", b"<html")):
        return "a web page, likely from a wrong address"
    return None
