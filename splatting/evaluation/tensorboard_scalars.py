"""Scalars of TensorBoard's event files, read without TensorBoard.

An event file is a row of records: length (8 bytes), checksum (4), content, checksum (4). A content is a protocol buffer
`Event`: field 1 wall_time, 2 step, 5 summary; a summary has values (field 1) of tag (1) and simple_value (2).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from splatting.files.plain_files import plain
from utils.system_utils import UserError

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # kinds of fields


class Scalar(NamedTuple):
    """A value at a step, and the seconds since 1970 at which it was written."""

    step: int
    wall: float
    value: float


def read_scalars(folder: Path) -> dict[str, list[Scalar]]:
    """Read the scalars of all event files in a folder by tag, in the order of their steps.

    Of several at one step the one written last counts. A file that is cut short gives what is whole. Checksums are not
    compared. UserError for a damaged file.
    """
    found: dict[str, dict[int, Scalar]] = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        try:
            scalars = [pair for content in _records(plain(path).read_bytes()) for pair in _scalars(content)]
        except (OSError, TypeError, ValueError, struct.error) as error:
            raise UserError(f"the TensorBoard files in {folder} are damaged ({error}); train again") from error
        for tag, scalar in scalars:
            before = found.setdefault(tag, {}).get(scalar.step)
            if before is None or before.wall <= scalar.wall:
                found[tag][scalar.step] = scalar
    return {tag: [steps[step] for step in sorted(steps)] for tag, steps in found.items()}


def _records(data: bytes) -> Iterator[bytes]:
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        if at + 12 + length + 4 > len(data):
            return
        yield data[at + 12 : at + 12 + length]
        at += 12 + length + 4


def _scalars(event: bytes) -> Iterator[tuple[str, Scalar]]:
    fields = dict(_fields(event))
    summary = fields.get(5)
    if not isinstance(summary, bytes):
        return
    wall = struct.unpack("<d", fields.get(1, bytes(8)))[0]
    for _, value in _fields(summary):
        parts = dict(_fields(value))
        if isinstance(parts.get(1), bytes) and isinstance(parts.get(2), bytes) and len(parts[2]) == 4:
            number = struct.unpack("<f", parts[2])[0]
            yield parts[1].decode("utf-8", "replace"), Scalar(int(fields.get(2, 0)), wall, number)


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Number and content of each field: an integer, or bytes. ValueError if the message is cut."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield key >> 3, value
            continue
        if kind == _BYTES:
            size, at = _varint(message, at)
        elif kind in (_EIGHT, _FOUR):
            size = 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"a field of kind {kind}")
        if at + size > len(message):
            raise ValueError("a field is cut")
        yield key >> 3, message[at : at + size]
        at += size


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(message) or shift > 63:
            raise ValueError("a number is cut")
        byte = message[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
