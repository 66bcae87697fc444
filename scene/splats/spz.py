"""SPZ, the format of Niantic and Adobe: versions 2 to 4 are written, versions 1 to 4 are read.

Published in the README of github.com/nianticlabs/spz. Version 4 is a header of 32 bytes, a table of streams, and a zstd
stream for each attribute: positions (24-bit fixed point), opacities, colours, logarithms of scales (steps of 1/16 from
-10), rotations (the index of the largest component in 2 bits, the others in 10: sign and size) and SH coefficients
(range +-1, all 8 bits used), one splat after the other. Axes are those of OpenGL: x right, y up, z back. Version 3 is
one gzip stream of all these, version 2 with rotations of 3 bytes: x, y and z of the quaternion whose w is not negative.
Version 1 has positions of 16-bit floats.

Extension records (kind, size and content) stand before the table, or at the end of the gzip stream. One of them says
that the axes are others.
"""

import gzip
import io
import os
import struct
import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import NamedTuple

import numpy as np

from groundwork.files.plain_files import check_packed_rows
from groundwork.files.unread import note_unread
from scene.splats.packing import morton_order, smallest_three, spread, to_bytes, whole_quaternions
from scene.splats.splats import Splats, from_axes, half_rotated, logits, opacities, selected
from utils.system_utils import UserError, atomic_write

MAGIC = 0x5053474E
WRITTEN = 4, 3, 2  # versions, the default first
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, splats, SH degree, bits of a fraction, flags, streams
_HEADER_END = struct.Struct("<I12x")  # of version 4: where the table of streams begins
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_COORDINATES = 0xADBE0003  # a record of one number: that of the file's axes
_SYSTEMS = (  # by that number, from 1
    *(x + y + z for z in "BF" for y in "DU" for x in "LR"),
    *(x + y + z for y in "FB" for z in "DU" for x in "LR"),
)
_MOST_RECORDS = 1 << 24  # bytes, as a packed stream may have any number
_COLOR = 0.15  # colours are 0.5 + 0.15 SH0, so that those beyond [0, 1] fit
_MOST_BITS = 20  # of a position's fraction
_LARGEST_POSITION = (1 << 23) - 1
_FARTHEST = 1000.0  # usual distances from the middle; no move within the model shows how far it is beyond
_SIZES = -10.0, 255 / 16 - 10  # logarithms of scales that it can hold
_LEVEL = 3  # of zstd; level 19 takes 70 times as long and saves 2 %


class _Header(NamedTuple):
    """The fields that all versions have, after the magic number."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int


def write_spz(path: str | os.PathLike, splats: Splats, version: int = WRITTEN[0]) -> None:
    """Write one of the versions WRITTEN, whole or not at all. UserError without zstandard, which version 4 needs."""
    zstandard = find_zstandard(path) if version == 4 else None
    splats = _move_farthest_in(splats)
    warn_of_sizes([splats])
    splats = selected(splats, morton_order(splats.means))
    content = _pack_by_zstd(splats, zstandard) if zstandard else packed_spz(splats, version)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _pack_by_zstd(splats: Splats, zstandard: ModuleType) -> bytes:
    """Pack a whole file of version 4."""
    splats = half_rotated(splats)
    bits, streams = _encode_streams(splats, _encode_rotations(splats.rotations))
    compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True)
    packed = [compressor.compress(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    header = _pack_header(4, splats, bits, len(streams)) + _HEADER_END.pack(_HEADER.size + _HEADER_END.size)
    return header + table + b"".join(packed)


def packed_spz(splats: Splats, version: int) -> bytes:
    """Pack a whole file of version 2 or 3, splats in their order. UserError for positions that it cannot hold."""
    splats = half_rotated(splats)
    rotations = _encode_three_bytes if version == 2 else _encode_rotations
    bits, streams = _encode_streams(splats, rotations(splats.rotations))
    return gzip.compress(_pack_header(version, splats, bits, 0) + b"".join(streams), mtime=0)


def _pack_header(version: int, splats: Splats, bits: int, streams: int) -> bytes:
    flags = _ANTIALIASED if splats.antialiasing else 0
    return _HEADER.pack(MAGIC, version, len(splats), splats.sh_degree, bits, flags, streams)


def _encode_streams(splats: Splats, rotations: np.ndarray) -> tuple[int, list[bytes]]:
    """Bits of a position's fraction, and the attributes of splats with OpenGL's axes. rotations: of the version."""
    farthest = float(np.abs(splats.means).max(initial=0))
    if farthest > _LARGEST_POSITION:
        raise UserError(
            f"SPZ can hold positions to {_LARGEST_POSITION:,}, not {farthest:.3g}; leave the farthest out by --crop, "
            "or end --to with .ply"
        )
    bits = int(np.clip(np.floor(np.log2(_LARGEST_POSITION / max(farthest, 1e-30))), 0, _MOST_BITS))
    tables = [
        _encode_fixed_point(splats.means, bits),
        to_bytes(opacities(splats) * 255),
        to_bytes((splats.sh[:, 0].astype(np.float64) * _COLOR + 0.5) * 255),
        to_bytes((splats.log_scales.astype(np.float64) + 10) * 16),
        rotations,
    ]
    if splats.sh_degree:  # readers refuse an empty stream
        tables.append(to_bytes(splats.sh[:, 1:] * 128 + 128))
    return bits, [table.tobytes() for table in tables]


def _move_farthest_in(splats: Splats) -> Splats:
    """Move the farthest splats nearer and shrink them, so that they look the same from the middle.

    All positions have the same step, which one splat far away would make coarse. A message counts the changed splats.
    """
    middle, distances, usual = spread(splats.means)
    limit = _FARTHEST * usual
    far = distances > limit
    if not far.any():
        return splats
    print(
        f"warning: {far.sum()} of {len(splats)} Gaussians lie more than {limit:.3g} from the middle of the model, and "
        "would cost all others precision in SPZ; they are moved to that distance and scaled down; --crop drops them",
        file=sys.stderr,
    )
    means, log_scales = splats.means.copy(), splats.log_scales.copy()
    part = (limit / distances[far])[:, None]
    means[far] = middle + (means[far] - middle) * part
    log_scales[far] += np.log(part)
    return replace(splats, means=means, log_scales=log_scales)


def warn_of_sizes(parts: Sequence[Splats]) -> None:
    """Say how many splats have a size that the format cannot hold, if any do: those of a model in another unit."""
    least, most = _SIZES
    longest = np.concatenate([splats.log_scales.max(axis=1, initial=-np.inf) for splats in parts])
    if cut := int(((longest < least) | (longest > most)).sum()):
        print(
            f"warning: SPZ holds lengths from {np.exp(least):.2g} to {np.exp(most):.0f} units; {cut} of {len(longest)} "
            "Gaussians are shorter or longer, and change; choose a format that keeps them: .ply, or tileset.json",
            file=sys.stderr,
        )


def find_zstandard(path: str | os.PathLike) -> ModuleType:
    """The package that a file of this name needs. UserError without it."""
    try:
        import zstandard
    except ImportError as error:
        raise UserError(f"{path} needs the package zstandard; install it with pip install '.[export]'") from error
    return zstandard


def _encode_fixed_point(means: np.ndarray, bits: int) -> np.ndarray:
    fixed = np.clip(np.round(means.astype(np.float64) * 2**bits), -_LARGEST_POSITION, _LARGEST_POSITION)
    return fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _encode_three_bytes(wxyz: np.ndarray) -> np.ndarray:
    """Rotations of version 2. A reader finds w by the others, whose rounding matters much where w is small.

    So x, y and z are each rounded down or up by what gives the nearest rotation.
    """
    places = (wxyz[:, 1:] * np.where(wxyz[:, :1] < 0, -1, 1) + 1) * 127.5
    best, nearest = np.zeros(places.shape, np.uint8), np.full(len(wxyz), -1.0)
    for up in np.ndindex(2, 2, 2):
        codes = np.clip(np.floor(places) + up, 0, 255).astype(np.uint8)
        read = _read_rotations(codes)
        cosine = np.abs((read * wxyz).sum(axis=1)) / np.linalg.norm(read, axis=1)
        better = cosine > nearest
        best[better], nearest[better] = codes[better], cosine[better]
    return best


def _encode_rotations(wxyz: np.ndarray) -> np.ndarray:
    largest, three = smallest_three(np.roll(wxyz, -1, axis=1))
    size = np.floor(np.abs(three) * np.sqrt(2) * 511 + 0.5).clip(0, 511).astype(np.uint32)
    first, second, third = (size | (three < 0).astype(np.uint32) << 9).T
    return (largest.astype(np.uint32) << 30 | first << 20 | second << 10 | third).astype("<u4")


def read_spz(path: str | os.PathLike) -> Splats:
    """Read a file of this format; SH bands above degree 3 are left out, with a warning. UserError if it is damaged."""
    with open(path, "rb") as file:
        content = file.read()
    try:
        return (_read_gzip if content[:2] == b"\x1f\x8b" else _read_zstd)(content, path)
    except (ValueError, struct.error, EOFError, OSError, zlib.error, IndexError, MemoryError) as error:
        raise UserError(f"{path} is not a complete SPZ file ({error}); save or download it again") from error


def _read_header(content: bytes, versions: tuple[int, ...], size: int) -> _Header:
    """The header at the start of unpacked bytes. size: bytes of the file. ValueError unless it can be what it says."""
    magic, *fields = _HEADER.unpack_from(content)
    header = _Header(*fields)
    if magic != MAGIC or header.version not in versions:
        fault = f"no version that this program knows: {header.version}"
        raise ValueError(fault if magic == MAGIC else "no magic number")
    if header.degree > 4:
        raise ValueError(f"SH bands of degree {header.degree}, of at most 4")
    check_packed_rows(header.count, size)
    return header


def _list_widths(header: _Header) -> list[int]:
    """Bytes a splat of each stream: positions, opacities, colours, scales, rotations, SH bands."""
    position, rotation = 6 if header.version == 1 else 9, 3 if header.version < 3 else 4
    return [position, 1, 3, 3, rotation, 3 * ((header.degree + 1) ** 2 - 1)]


def _read_axes(records: bytes, header: _Header, path: str | os.PathLike) -> str:
    """The axes that a record declares, or OpenGL's. What else records and flags say is named."""
    place, axes, others = 0, "RUB", []
    while place < len(records):
        kind, size = struct.unpack_from("<II", records, place)
        content = records[place + 8 : place + 8 + size]
        if len(content) < size:
            raise ValueError(f"an extension record has {len(content)} of {size} bytes")
        number = int.from_bytes(content[:4], "little")
        if kind == _COORDINATES and 0 < number <= len(_SYSTEMS):
            axes = _SYSTEMS[number - 1]
        else:
            others.append(f"0x{kind:08X}" + (f" (axes {number})" if kind == _COORDINATES else ""))
        place += 8 + size
    if flags := header.flags & ~(_ANTIALIASED | _EXTENDED):
        others.append(f"flags 0x{flags:02X}")
    note_unread(path, "spz", others)
    return axes


def _read_zstd(content: bytes, path: str | os.PathLike) -> Splats:
    """Read a file of version 4: streams compressed by Zstandard. path: for messages."""
    header = _read_header(content, (4,), len(content))
    (table,) = _HEADER_END.unpack_from(content, _HEADER.size)
    zstandard = find_zstandard(path)
    begin, parts = table + 16 * header.streams, []
    for index, width in enumerate(_list_widths(header)):
        size = width * header.count
        packed, whole = struct.unpack_from("<QQ", content, table + 16 * index) if index < header.streams else (0, 0)
        if whole != size:
            raise ValueError(f"stream {index} promises {whole} bytes instead of {size}")
        try:
            part = content[begin : begin + packed]
            if size and zstandard.frame_content_size(part) not in (-1, size):  # memory is taken for what it says
                raise ValueError(f"stream {index} does not have its {size} bytes")
            parts.append(zstandard.ZstdDecompressor().decompress(part, max_output_size=size) if size else b"")
        except zstandard.ZstdError as error:
            raise ValueError(f"stream {index}: {error}") from error
        begin += packed
    records = content[_HEADER.size + _HEADER_END.size : table] if header.flags & _EXTENDED else b""
    return _decode_splats(parts, header, _read_axes(records, header, path))


def _read_gzip(content: bytes, path: str | os.PathLike) -> Splats:
    """Read a file of version 1 to 3: one gzip stream of header and tables. path: for messages."""
    stream = gzip.GzipFile(fileobj=io.BytesIO(content))
    header = _read_header(stream.read(_HEADER.size), (1, 2, 3), len(content))
    # No more than that, however much is packed.
    parts = [stream.read(width * header.count) for width in _list_widths(header)]
    records = stream.read(_MOST_RECORDS) if header.flags & _EXTENDED else b""
    if stream.read(1):  # at the end it checks the sum
        raise ValueError("it holds more than its header says")
    return _decode_splats(parts, header, _read_axes(records, header, path))


def _decode_splats(parts: list[bytes], header: _Header, axes: str) -> Splats:
    """Decode the tables of a file into splats.

    parts: bytes of each table, in the order of `_list_widths`. axes: "RUB", or the names of other axes of the file.
    """
    count, degree = header.count, header.degree
    tables = [
        np.frombuffer(part, np.uint8).reshape(count, width)
        for part, width in zip(parts, _list_widths(header), strict=True)
    ]
    positions, alpha, color, scales, rotations, rest = tables
    rest = rest.reshape(count, (degree + 1) ** 2 - 1, 3)[:, :15].astype(np.float32)
    rest /= 128  # in place, as these are most of the memory
    rest -= 1
    if degree > 3:
        print(f"warning: SH bands of degree {degree} are left out; models have at most degree 3", file=sys.stderr)
    if header.version == 1:
        means = np.ascontiguousarray(positions).view("<f2")
    else:
        wide = np.zeros((count, 3, 4), np.uint8)
        wide[:, :, 1:] = positions.reshape(count, 3, 3)
        means = (wide.view("<i4")[:, :, 0] >> 8) / 2.0**header.bits
    base = (color / 255.0 - 0.5) / _COLOR
    sh = np.concatenate([base.astype(np.float32)[:, None], rest], axis=1)
    values = (means, scales / 16.0 - 10, _read_rotations(rotations), logits(alpha[:, 0] / 255.0, 1 / 255), sh)
    values = (x.astype(np.float32, copy=False) for x in values)
    splats = Splats(*values, bool(header.flags & _ANTIALIASED))
    return half_rotated(splats) if axes == "RUB" else from_axes(splats, axes)


def _read_rotations(table: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of 4 bytes each, or of 3: x, y and z of the version before 3."""
    if table.shape[1] == 3:
        three = table / 127.5 - 1
        return np.concatenate([np.sqrt(np.clip(1 - (three**2).sum(axis=1, keepdims=True), 0, 1)), three], axis=1)
    codes = np.ascontiguousarray(table).view("<u4").reshape(-1)
    each = np.stack([codes >> np.uint32(20), codes >> np.uint32(10), codes], axis=1) & np.uint32(1023)
    three = np.where(each & 512, -1.0, 1.0) * (each & 511) / 511 / np.sqrt(2)
    return np.roll(whole_quaternions((codes >> np.uint32(30)).astype(np.int64), three), 1, axis=1)
