"""Check of the header of a PLY file, before a parser reads it line by line."""

import os

_LONGEST = 1 << 20  # bytes; those of trained models have some 2,000


def check_header(path: str | os.PathLike) -> None:
    """ValueError if the header does not end within the first MiB: a parser would take minutes and much memory."""
    with open(path, "rb") as file:
        if b"end_header" not in file.read(_LONGEST):
            raise ValueError("there is no end_header in its first MiB")
