"""What a file is that is not what its name says: the usual accidents of downloads and clones."""

import os

_HEAD = 256


def not_the_file(path: str | os.PathLike) -> str | None:
    """What stands in place of a file's content: nothing, a pointer of Git LFS, a web page; None: none of these."""
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return None
    if not head:
        return "empty"
    if head.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS, whose content git lfs pull fetches"
    if head.lstrip()[:9].lower().startswith((b"<!doctype", b"<html")):
        return "a web page, as downloads of a wrong address are"
    return None
