"""Contents of TensorBoard's event files, made without TensorBoard.

An event file is a row of records: length (8 bytes), its checksum (4), content, its checksum (4). A content is a
protocol buffer `Event`: field 1 wall_time, 2 step, 3 file_version, 5 summary. A summary has values (field 1) of tag (1)
and simple_value (2), image (4: height 1, width 2, channels 3, PNG 4) or histogram (5: smallest 1, largest 2, count 3,
sum 4, sum of squares 5, upper limits of the buckets 6, their counts 7).
"""

import io
import struct

import numpy as np
from PIL import Image

from utils.files.crc32c import crc32c

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # kinds of fields
_SMALLEST, _GROWTH, _BUCKETS = 1e-12, 1.1, 774  # of a histogram: exponential on both sides of zero, up to 1e20


def first_record(wall: float) -> bytes:
    """The record that an event file begins with."""
    return _record(_double(1, wall) + _bytes(3, b"brain.Event:2"))


def value_record(wall: float, step: int | None, value: bytes) -> bytes:
    """The record of a value at a step, written at `wall`, seconds since 1970."""
    return _record(_double(1, wall) + _int(2, step or 0) + _bytes(5, _bytes(1, value)))


def scalar(tag: str, number: float) -> bytes:
    """A value that is a number."""
    with np.errstate(over="ignore"):  # infinity is what becomes of a number too large
        return _tag(tag) + _key(2, _FOUR) + np.array(number, "<f4").tobytes()


def image(tag: str, pixels: np.ndarray) -> bytes:
    """A value that is an image (H, W, 3) uint8."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG", compress_level=1)  # a tenth larger, in half the time
    height, width, channels = pixels.shape
    content = _int(1, height) + _int(2, width) + _int(3, channels) + _bytes(4, file.getvalue())
    return _tag(tag) + _bytes(4, content)


def histogram(tag: str, values: np.ndarray) -> bytes:
    """A value that is a histogram of at least one number, all finite."""
    values = values.astype(np.float64).reshape(-1)
    upper = _SMALLEST * _GROWTH ** np.arange(_BUCKETS)
    limits = np.concatenate([-upper[::-1], [0.0], upper])
    counts = np.histogram(values, limits)[0]
    filled = counts.nonzero()[0]
    first, last = (filled[0], filled[-1] + 1) if len(filled) else (0, 1)
    content = b"".join(
        _double(number, float(x))
        for number, x in enumerate((values.min(), values.max(), len(values), values.sum(), (values**2).sum()), 1)
    )
    # A bucket of none in front tells where the first one begins.
    content += _doubles(6, limits[first : last + 1]) + _doubles(7, np.concatenate([[0.0], counts[first:last]]))
    return _tag(tag) + _bytes(5, content)


def _record(content: bytes) -> bytes:
    length = struct.pack("<Q", len(content))
    return length + _checksum(length) + content + _checksum(content)


def _checksum(data: bytes) -> bytes:
    crc = crc32c(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)  # masked, as the format wants


def _tag(tag: str) -> bytes:
    return _bytes(1, tag.encode("utf-8", "backslashreplace"))


def _key(number: int, kind: int) -> bytes:
    return bytes([number << 3 | kind])


def _double(number: int, value: float) -> bytes:
    return _key(number, _EIGHT) + struct.pack("<d", value)


def _doubles(number: int, values: np.ndarray) -> bytes:
    return _bytes(number, values.astype("<f8").tobytes())


def _int(number: int, value: int) -> bytes:
    return _key(number, _VARINT) + _varint(value)


def _bytes(number: int, content: bytes) -> bytes:
    return _key(number, _BYTES) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """A number >= 0, seven bits a byte, the lowest first."""
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])
