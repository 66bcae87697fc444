"""Header of a PLY file: a check, before a parser reads it line by line, and its comments and properties."""

import os

_LONGEST = 1 << 20  # bytes; those of trained models have some 2,000


def check_header(path: str | os.PathLike) -> None:
    """ValueError if the header does not end within the first MiB: a parser would take minutes and much memory."""
    with open(path, "rb") as file:
        if b"end_header" not in file.read(_LONGEST):
            raise ValueError("there is no end_header in its first MiB")


def header_lines(path: str | os.PathLike) -> list[str]:
    """The lines of the header, without its end; what is not ASCII is replaced. [] for a file that is no PLY."""
    with open(path, "rb") as file:
        begin = file.read(_LONGEST)
    if not begin.startswith(b"ply"):
        return []
    return begin.split(b"end_header")[0].decode("ascii", "replace").splitlines()
