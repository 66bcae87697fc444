"""Compressed PLY, the format of PlayCanvas and SuperSplat: 16 bytes a splat, and a byte for each SH coefficient.

Splats come in chunks of 256, near each other. A chunk has the least and the greatest position, logarithm of scale and
colour; a splat has each as a part of that range: position and scale in 11, 10 and 11 bits (x in the highest), colour
and opacity in 8 each, and its quaternion as the index of the largest component (2 bits) and the others (10 bits each,
of a range of +-sqrt(1/2)). SH coefficients of the range +-4 are in the element sh, 8 bits each, channel by channel.
Axes are those of the model.

Splats that lie far from the others would coarsen the steps of their chunk, so they have chunks of their own. The chunk
before is filled up with padding: splats without opacity whose positions, scales and colours are all zero bits.
"""

import os

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from exports.packing import from_bits, morton_order, smallest_three, spread, to_bits, whole_quaternions
from exports.plain_ply import comments, says_antialiasing, stored_offset
from exports.selection import logits, opacities, selected
from exports.splats import Splats
from utils.files.ply_header import header_lines, read_elements
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write

CHUNK = 256
SH_RANGE = 8.0  # coefficients from -4 to 4
_LOG_SCALES = 20.0  # beyond this, readers clamp
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_VISIBLE = ("packed_position", "packed_scale", "packed_color")  # all zero in padding
_FAR = 10.0  # usual distances from the middle, of positions or of colours
_RANGES = {"": "xyz", "scale_": "xyz", "color": "rgb"}  # groups of a chunk's columns


def is_compressed_ply(path: str | os.PathLike) -> bool:
    """Whether the header of a PLY names packed positions."""
    return any(line.split()[-1:] == ["packed_position"] for line in header_lines(path))


def write_compressed_ply(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all."""
    packed = packed_ply(splats)
    with atomic_write(path) as temporary:
        packed.write(str(temporary))


def packed_ply(splats: Splats) -> PlyData:
    """The tables of the file and its comments."""
    order, padding = _in_chunks(splats)
    splats = selected(splats, order)
    count = len(splats)
    first = np.arange(0, count, CHUNK)
    chunk_of = np.arange(count) // CHUNK
    parts, ranges = {}, []
    for name, values in _grouped(splats).items():
        low, high = (f.reduceat(values, first, axis=0) if count else values for f in (np.minimum, np.maximum))
        ranges.append((_columns(name), np.concatenate([low, high], axis=1)))
        size = np.where(high > low, high.astype(np.float64) - low, 1)
        parts[name] = (values - low.astype(np.float64)[chunk_of]) / size[chunk_of]
    vertex = np.zeros(count, dtype=[(name, "<u4") for name in _PACKED])
    vertex["packed_position"] = _three(parts[""])
    vertex["packed_rotation"] = _rotations(splats.rotations)
    vertex["packed_scale"] = _three(parts["scale_"])
    red, green, blue = to_bits(parts["color"], 8).T
    vertex["packed_color"] = red << 24 | green << 16 | blue << 8 | to_bits(opacities(splats), 8)
    for name in _VISIBLE:
        vertex[name][padding] = 0
    elements = [_table("chunk", ranges, "<f4"), PlyElement.describe(vertex, "vertex")]
    if splats.sh_degree:
        codes = np.floor((splats.sh[:, 1:] / np.float32(SH_RANGE) + np.float32(0.5)) * 256)  # float64 would take GBs
        codes = codes.clip(0, 255).astype(np.uint8).transpose(0, 2, 1).reshape(count, 3 * (splats.sh.shape[1] - 1))
        elements.append(_table("sh", [([f"f_rest_{i}" for i in range(codes.shape[1])], codes)], "u1"))
    return PlyData(elements, byte_order="<", comments=comments(splats))


def _in_chunks(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the splats in the order of the file, and which of them are padding.

    Those within _FAR usual distances come first, then those within _FAR times that, and so on.
    """
    shells = np.zeros(len(splats))
    for values in (splats.means, splats.sh[:, 0]):
        _, distances, usual = spread(values)
        shells = np.maximum(shells, np.ceil(np.log(np.maximum(distances / usual, 1)) / np.log(_FAR)) - 1)
    order, padding = np.zeros(0, np.int64), np.zeros(0, bool)
    for shell in np.unique(shells):
        missing = -len(order) % CHUNK
        own = np.flatnonzero(shells == shell)
        own = own[morton_order(splats.means[own])]
        order = np.concatenate([order, np.repeat(order[-1:], missing), own])
        padding = np.concatenate([padding, np.ones(missing, bool), np.zeros(len(own), bool)])
    return order, padding


def _grouped(splats: Splats) -> dict[str, np.ndarray]:
    return {
        "": splats.means,
        "scale_": np.clip(splats.log_scales, -_LOG_SCALES, _LOG_SCALES),
        "color": (splats.sh[:, 0] * C0 + 0.5).astype(np.float32),
    }


def _columns(group: str) -> list[str]:
    prefix = "" if group == "color" else group
    return [f"{end}_{prefix}{axis}" for end in ("min", "max") for axis in _RANGES[group]]


def _table(name: str, parts: list[tuple[list[str], np.ndarray]], kind: str) -> PlyElement:
    names = [column for columns, _ in parts for column in columns]
    table = np.zeros(len(parts[0][1]), dtype=[(column, kind) for column in names])
    for columns, values in parts:
        for i, column in enumerate(columns):
            table[column] = values[:, i]
    return PlyElement.describe(table, name)


def _three(parts: np.ndarray) -> np.ndarray:
    x, y, z = (to_bits(parts[:, axis], bits) for axis, bits in enumerate((11, 10, 11)))
    return x << 21 | y << 11 | z


def _rotations(wxyz: np.ndarray) -> np.ndarray:
    largest, three = smallest_three(wxyz)
    a, b, c = to_bits(three / np.sqrt(2) + 0.5, 10).T
    return largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c


def read_compressed_ply(path: str | os.PathLike) -> Splats:
    """Read a file of this format, also without ranges of colours, as older ones are; padding is left out.

    UserError if it is damaged.
    """
    try:
        ply = read_elements(path)
        chunks, vertex = ply["chunk"].data, ply["vertex"].data
        packed = [np.asarray(vertex[name]).astype(np.uint32) for name in _PACKED]
        chunk_of = np.arange(len(vertex)) // CHUNK
        if len(chunks) != -(-len(vertex) // CHUNK):
            raise ValueError(f"{len(chunks)} chunks for {len(vertex)} splats")
        rest = _read_rest(ply, len(vertex))
        position, log_scales = (
            _between(chunks, group, chunk_of, _parts(code)) for group, code in (("", packed[0]), ("scale_", packed[2]))
        )
        color = np.stack([from_bits(packed[3] >> np.uint32(shift), 8) for shift in (24, 16, 8)], axis=1)
        color = _between(chunks, "color", chunk_of, color) if "min_r" in chunks.dtype.names else color
    except (PlyParseError, ValueError, KeyError, TypeError, OverflowError, EOFError, MemoryError) as error:
        raise UserError(f"{path} is not a complete compressed PLY ({error}); save or download it again") from error
    shifted = np.stack([from_bits(packed[1] >> np.uint32(shift), 10) for shift in (20, 10, 0)], axis=1)
    rotations = whole_quaternions((packed[1] >> np.uint32(30)).astype(np.int64), (shifted - 0.5) * np.sqrt(2))
    sh = np.concatenate([((color - 0.5) / C0).astype(np.float32)[:, None], rest], axis=1)
    alpha = logits(from_bits(packed[3], 8), 1 / 255)
    values = (x.astype(np.float32) for x in (position, log_scales, rotations, alpha, sh))
    whole = Splats(*values, antialiasing=says_antialiasing(path), world_offset=stored_offset(path))
    shown = np.any([vertex[name] for name in _VISIBLE], axis=0)
    return whole if shown.all() else selected(whole, shown)


def _parts(codes: np.ndarray) -> np.ndarray:
    return np.stack(
        [from_bits(codes >> np.uint32(shift), bits) for shift, bits in ((21, 11), (11, 10), (0, 11))], axis=1
    )


def _between(chunks: np.ndarray, group: str, chunk_of: np.ndarray, parts: np.ndarray) -> np.ndarray:
    columns = [np.asarray(chunks[name], np.float64) for name in _columns(group)]
    low, high = np.stack(columns[:3], axis=1)[chunk_of], np.stack(columns[3:], axis=1)[chunk_of]
    return low + (high - low) * parts


def _read_rest(ply: PlyData, count: int) -> np.ndarray:
    """SH coefficients above band 0, (N, K, 3)."""
    if "sh" not in ply:
        return np.zeros((count, 0, 3), np.float32)
    table = ply["sh"].data
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names))]
    codes = np.stack([np.asarray(table[name]).astype(np.uint8) for name in names], axis=1)
    if len(table) != count or len(names) not in (9, 24, 45):
        raise ValueError(f"{len(names)} SH values for each of {len(table)} splats")
    # The middle of each step, but the whole range at its ends.
    steps = np.concatenate([[0], (np.arange(1, 255) + 0.5) / 256, [1]])
    values = ((steps - 0.5) * SH_RANGE).astype(np.float32)
    return values[codes].reshape(count, 3, len(names) // 3).transpose(0, 2, 1)
