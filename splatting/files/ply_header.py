"""PLY files from strangers: the lines of the header, and the elements once the file is long enough for them."""

import os

from plyfile import PlyData

_LONGEST = 1 << 20  # bytes; the headers of trained models have some 2,000
_END = "end_header"


def header_lines(path: str | os.PathLike) -> list[str]:
    """The lines of the header, cut where plyfile cuts them, with `end_header` if it is in the first MiB.

    What is not ASCII is replaced. [] for a file that is no PLY.
    """
    with open(path, "rb") as file:
        begin = file.read(_LONGEST)
    if not begin.startswith(b"ply"):
        return []
    newline = next((end for end in (b"\r\n", b"\r") if begin.startswith(end, 3)), b"\n")
    lines = begin.split(newline)
    if _END.encode() in lines:
        del lines[lines.index(_END.encode()) + 1 :]
    return [line.decode("ascii", "replace") for line in lines]


def read_elements(path: str | os.PathLike) -> PlyData:
    """The elements of a PLY. Before plyfile makes room for their rows, the header and the size of the file are checked.

    ValueError if the header does not end within the first MiB, of which a parser would take minutes and much memory, or
    if the file is too short for its rows. PlyParseError and others as from plyfile.
    """
    lines = header_lines(path)
    if lines[-1:] != [_END]:
        raise ValueError("there is no end_header in its first MiB")
    size, least, name, rows, width = os.path.getsize(path), 0, "", "0", 1
    for words in map(str.split, lines):
        if words[:2] == ["format", "ascii"]:
            width = 2  # bytes of a value: a digit and what parts it from the next one
        elif words[:1] == ["element"]:
            name, rows = words[1], words[-1]
        elif words[:1] == ["property"]:
            least += max(int(rows), 0) * width
        if least > size + 1:  # the last line of a text may have no end
            count = f"{int(rows):,}" if len(rows) < 16 else f"{float(rows):.4g}"
            what = "vertices" if name == "vertex" else f"rows of {name}"
            raise ValueError(f"{count} {what} announced, file ends after {size:,} bytes")
    return PlyData.read(os.fspath(path))
