"""Check of the number of rows that the header of a PLY file promises, before a parser makes room for them."""

import os
import re

_HEADER = 1 << 20  # bytes that are searched


def check_rows(path: str | os.PathLike) -> None:
    """ValueError if the file is too short for its vertices, each value of which takes a byte, or two as text."""
    with open(path, "rb") as file:
        header = file.read(_HEADER).partition(b"end_header")[0]
    element = re.search(rb"^element[ \t]+vertex[ \t]+(\d+)(.*?)(?=^element|\Z)", header, re.MULTILINE | re.DOTALL)
    if element is None:
        return
    values = len(re.findall(rb"^property[ \t]", element[2], re.MULTILINE))
    least = int(element[1]) * values * (2 if re.search(rb"^format[ \t]+ascii", header, re.MULTILINE) else 1)
    size = os.path.getsize(path)
    if least > size + 1:  # the last line of a text may have no end
        raise ValueError(f"its header promises {float(element[1]):.4g} vertices, and it has {size} bytes")
