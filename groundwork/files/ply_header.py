"""Read PLY files that may be damaged or hostile: header lines, and elements once the file is known to hold them."""

import codecs
import io
import os
from pathlib import Path

from plyfile import PlyData

from groundwork.files.plain_files import encoding_of

_LONGEST = 1 << 20  # bytes; the headers of trained models have some 2,000
_END = "end_header"


def header_lines(path: str | os.PathLike) -> list[str]:
    """The lines of the header, cut where plyfile cuts them, with `end_header` if it is in the first MiB.

    Other characters than ASCII are replaced, blanks around a line are cut. [] for a file that is no PLY.
    """
    with open(path, "rb") as file:
        return _read_header(_encode_text(file.read(_LONGEST), encoding_of(path)))[0]


def _encode_text(content: bytes, encoding: str) -> bytes:
    """Encode the text of a PLY without a mark at its start."""
    if encoding == "utf-8-sig":
        return content.removeprefix(codecs.BOM_UTF8)
    return content.decode(encoding, "replace").encode("ascii", "replace")


def _read_header(begin: bytes) -> tuple[list[str], bytes, int]:
    """Return the lines of the header at the start of bytes, their line end, and their number of bytes."""
    if not begin.startswith(b"ply"):
        return [], b"", 0
    newline = next((end for end in (b"\r\n", b"\r") if begin.startswith(end, 3)), b"\n")
    lines, size = [], 0
    for line in begin.split(newline):
        lines.append(line.decode("ascii", "replace").strip())
        size += len(line) + len(newline)
        if lines[-1] == _END:
            break
    return lines, newline, size


def read_elements(path: str | os.PathLike) -> PlyData:
    """The elements of a PLY. Before plyfile makes room for their rows, the header and the size of the file are checked.

    ValueError if the header does not end within the first MiB, as a parser would take minutes and much memory for a
    longer one, or if the file is too short for its rows. PlyParseError and others as from plyfile.
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
    return PlyData.read(os.fspath(path) if _is_clean(path) else io.BytesIO(_clean_content(path)))


def _is_clean(path: str | os.PathLike) -> bool:
    """Tell whether plyfile accepts the header, which must be ASCII without blanks around its lines."""
    with open(path, "rb") as file:
        begin = file.read(_LONGEST)
    lines, newline, size = _read_header(begin)
    return (
        bool(lines)
        and all(lines)
        and begin[:size] == newline.join([line.encode("ascii", "replace") for line in lines] + [b""])
    )


def _clean_content(path: str | os.PathLike) -> bytes:
    """Return the content of a file with a header that plyfile accepts."""
    content = _encode_text(Path(path).read_bytes(), encoding_of(path))
    lines, newline, size = _read_header(content[:_LONGEST])
    return newline.join([line.encode("ascii", "replace") for line in lines if line] + [content[size:]])
