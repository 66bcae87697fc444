"""PLY files: with float32 properties, and the compressed form of PlayCanvas and SuperSplat.

The plain form has the reference's columns, and comments that say what they mean.

The compressed form has 16 bytes a splat, and a byte for each SH coefficient. Splats come in chunks of 256, near each
other. A chunk has the least and the greatest position, logarithm of scale and colour; a splat has each as a part of
that range: position and scale in 11, 10 and 11 bits (x in the highest), colour and opacity in 8 each, and its
quaternion as the index of the largest component (2 bits) and the others (10 bits each, of a range of +-sqrt(1/2)). SH
coefficients of the range +-4 are in the element sh, 8 bits each, channel by channel. Axes are those of the model.

Splats that lie far from the others would coarsen the steps of their chunk, so they have chunks of their own. The chunk
before is filled up with padding: splats without opacity whose positions, scales and colours are all zero bits.
"""

import contextlib
import math
import os

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from groundwork.files.json_files import LARGEST_OFFSET
from groundwork.files.ply_header import header_lines, read_elements
from groundwork.files.unread import note_unread
from scene.gaussians.ply import frame_comments, read_ply, read_vertices, write_ply
from scene.readers.info import origin_near
from scene.splats.packing import morton_order, pack, smallest_three, spread, unpack, whole_quaternions
from scene.splats.splats import Splats, base_colors, logits, opacities, selected, with_sh_degree
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write

AXES = "axes x right, y down, z forward (COLMAP)"
CHUNK = 256
SH_RANGE = 8.0  # coefficients from -4 to 4
_TOGETHER = 4096  # splats whose SH bands are packed at once: they fit into the processor's cache
_LOG_SCALES = 20.0  # beyond this, readers clamp
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_VISIBLE = ("packed_position", "packed_scale", "packed_color")  # all zero in padding
_SMALLEST = 10  # the part of the splats that tells whether most are a sky: one of these
_FAR = 10.0  # usual distances from the middle, of positions or of colours
_COLUMNS = {  # of a chunk
    "position": [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"],
    "scale": [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"],
    "color": [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"],
}


def comments(splats: Splats) -> list[str]:
    """Comments of our PLY files. Brush writes SplatRenderMode, and Postshot antialiased; viewers know both."""
    return [
        AXES,
        f"SplatRenderMode: {'mip' if splats.antialiasing else 'default'}",
        f"antialiased {splats.antialiasing:d}",
        *frame_comments(splats.world_offset, splats.enlargement),
    ]


def says_antialiasing(path: str | os.PathLike) -> bool:
    """Tell whether the comments of a PLY say that its splats were trained with antialiasing; the last one counts."""
    found = False
    for line in header_lines(path):
        words = line.lower().replace(":", " ").split()
        if words[:2] in (["comment", "splatrendermode"], ["comment", "antialiased"]):
            found = words[2:3] in (["mip"], ["1"])
    return found


def stored_offset(path: str | os.PathLike) -> tuple[float, float, float]:
    """World coordinates of a PLY's origin: those of our comment world_offset, zero without a finite one.

    UserError if they are too large.
    """
    for line in header_lines(path):
        words = line.split()
        if words[:2] == ["comment", "world_offset"] and len(words) == 5:
            with contextlib.suppress(ValueError):
                offset = tuple(float(word) for word in words[2:])
                if all(map(math.isfinite, offset)):
                    return _check_offset(offset, path)
    return 0.0, 0.0, 0.0


def stored_enlargement(path: str | os.PathLike) -> float:
    """The number above 0 of our comment enlargement, 1 without one."""
    for line in header_lines(path):
        words = line.split()
        if words[:2] == ["comment", "enlargement"] and len(words) == 3:
            with contextlib.suppress(ValueError):
                if 0 < (factor := float(words[2])) <= LARGEST_OFFSET:
                    return factor
    return 1.0


def _check_offset(offset: tuple[float, float, float], path: str | os.PathLike) -> tuple[float, float, float]:
    """Return a world offset (world units) unless it is larger than supported; then raise a UserError."""
    farthest = max(map(abs, offset))
    if farthest > LARGEST_OFFSET:
        raise UserError(
            f"{path} lies {farthest:.3g} from the origin of its world, but at most {LARGEST_OFFSET:g} is supported; "
            "correct its positions and its comment world_offset"
        )
    return offset


def columns_of(splats: Splats) -> dict[str, Tensor]:
    """The splats as columns of a model's PLY."""
    sh = torch.from_numpy(splats.sh)
    return {
        "xyz": torch.from_numpy(splats.means),
        "f_dc": sh[:, :1],
        "f_rest": sh[:, 1:],
        "opacity": torch.from_numpy(splats.opacity_logits)[:, None],
        "scaling": torch.from_numpy(splats.log_scales),
        "rotation": torch.from_numpy(splats.rotations),
    }


def write_plain_ply(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all."""
    write_ply(path, columns_of(splats), splats.sh_degree, comments=comments(splats))


def read_plain_ply(path: str | os.PathLike) -> Splats:
    """Read a Gaussian PLY of any tool. UserError as from scene/gaussians/ply.py.

    Doubles far from their origin, as of scene/export_world.py, become relative to one that is near them.
    """
    columns = {name: values.numpy() for name, values in read_ply(path, None, further=False).items()}
    offset = stored_offset(path)
    if any(line.split() in (["property", "double", "x"], ["property", "float64", "x"]) for line in header_lines(path)):
        columns["xyz"], origin = _move_near_origin(path, columns["xyz"])
        offset = _check_offset(tuple((origin + offset).tolist()), path)
    sh = np.concatenate([columns["f_dc"], columns["f_rest"]], axis=1)
    values = (columns["xyz"], columns["scaling"], columns["rotation"], columns["opacity"][:, 0], sh)
    return Splats(*values, says_antialiasing(path), offset, stored_enlargement(path))


def _move_near_origin(path: str | os.PathLike, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The positions (N,3) of a PLY of doubles as float32, and their origin (3,), which is zero unless they are far."""
    vertices = read_vertices(path)
    places = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
    finite = places[np.isfinite(places).all(axis=1)]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(3)
    extent = float(np.median(np.linalg.norm(finite - middle, axis=1))) if len(finite) else 0.0
    origin = origin_near(middle, extent) if extent else np.zeros(3)
    if not origin.any():
        return means, origin
    print(f"{path}: {' '.join(map(repr, origin.tolist()))} is subtracted from all positions to keep float32 precise")
    return (places - origin).astype(np.float32), origin


def write_compressed_ply(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all."""
    packed = packed_ply(splats)
    with atomic_write(path) as temporary:
        packed.write(str(temporary))


def packed_ply(splats: Splats) -> PlyData:
    """The tables of a compressed PLY and its comments."""
    order, padding = _order_in_chunks(splats)
    rest = _encode_rest(splats.sh[:, 1:])[order]  # bytes are put in order faster than floats
    splats = selected(with_sh_degree(splats, 0), order)
    count = len(splats)
    first = np.arange(0, count, CHUNK)
    chunk_of = np.arange(count) // CHUNK
    parts, ranges = {}, []
    for name, values in {
        "position": splats.means,
        "scale": np.clip(splats.log_scales, -_LOG_SCALES, _LOG_SCALES),
        "color": base_colors(splats),
    }.items():
        low, high = (f.reduceat(values, first, axis=0) if count else values for f in (np.minimum, np.maximum))
        ranges += [low, high]
        size = np.where(high > low, high.astype(np.float64) - low, 1)
        parts[name] = (values - low.astype(np.float64)[chunk_of]) / size[chunk_of]
    largest, three = smallest_three(splats.rotations)
    vertex = np.zeros(count, dtype=[(name, "<u4") for name in _PACKED])
    vertex["packed_position"] = pack(parts["position"], 11, 10, 11)
    vertex["packed_rotation"] = largest.astype(np.uint32) << 30 | pack(three / np.sqrt(2) + 0.5, 10, 10, 10)
    vertex["packed_scale"] = pack(parts["scale"], 11, 10, 11)
    vertex["packed_color"] = pack(np.column_stack([parts["color"], opacities(splats)]), 8, 8, 8, 8)
    for name in _VISIBLE:
        vertex[name][padding] = 0
    chunks = _make_element("chunk", sum(_COLUMNS.values(), []), np.concatenate(ranges, axis=1), "<f4")
    elements = [chunks, PlyElement.describe(vertex, "vertex")]
    if rest.shape[1]:
        elements.append(_make_element("sh", [f"f_rest_{i}" for i in range(rest.shape[1])], rest, "u1"))
    return PlyData(elements, byte_order="<", comments=comments(splats))


def _encode_rest(sh: np.ndarray) -> np.ndarray:
    """SH coefficients above band 0, (N, K, 3), as bytes (N, 3 K), channel by channel."""
    codes = np.empty((len(sh), 3, sh.shape[1]), np.uint8)
    for first in range(0, len(sh), _TOGETHER):
        some = slice(first, first + _TOGETHER)
        levels = np.floor((sh[some] / np.float32(SH_RANGE) + np.float32(0.5)) * 256)
        codes[some] = levels.clip(0, 255).astype(np.uint8).transpose(0, 2, 1)
    return codes.reshape(len(sh), 3 * sh.shape[1])


def _order_in_chunks(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the splats in the order of the file, and which of them are padding.

    Those within _FAR usual distances come first, then those within _FAR times that, and so on.
    """
    shells = np.zeros(len(splats))
    for distances, usual in (_measure_from_middle(splats), spread(splats.sh[:, 0])[1:]):
        shells = np.maximum(shells, np.ceil(np.log(np.maximum(distances / usual, 1)) / np.log(_FAR)) - 1)
    order, padding = np.zeros(0, np.int64), np.zeros(0, bool)
    for shell in np.unique(shells):
        missing = -len(order) % CHUNK
        own = np.flatnonzero(shells == shell)
        own = own[morton_order(splats.means[own])]
        order = np.concatenate([order, np.repeat(order[-1:], missing), own])
        padding = np.concatenate([padding, np.ones(missing, bool), np.zeros(len(own), bool)])
    return order, padding


def _measure_from_middle(splats: Splats) -> tuple[np.ndarray, float]:
    """Distances (N,) from the middle, and the usual one; of the smallest splats, if they stand far closer together.

    So they do amid a sky of more splats than all else.
    """
    _, distances, usual = spread(splats.means)
    sizes = splats.log_scales.max(axis=1, initial=-np.inf)
    smallest = np.argsort(sizes, kind="stable")[: -(-len(sizes) // _SMALLEST)]
    middle, _, close = spread(splats.means[smallest])
    if close * _FAR >= usual:
        return distances, usual
    return np.linalg.norm(splats.means.astype(np.float64) - middle, axis=1), close


def _make_element(name: str, columns: list[str], values: np.ndarray, kind: str) -> PlyElement:
    from numpy.lib.recfunctions import unstructured_to_structured  # it takes a tenth of a second to import

    form = np.dtype([(column, kind) for column in columns])
    return PlyElement.describe(unstructured_to_structured(values, form), name)


def read_compressed_ply(path: str | os.PathLike) -> Splats:
    """Read a compressed PLY, also without ranges of colours, as older ones are; padding is left out.

    UserError if it is damaged.
    """
    try:
        ply = read_elements(path)
        chunks, vertex = ply["chunk"].data, ply["vertex"].data
        position, rotation, scale, color = (np.asarray(vertex[name]).astype(np.uint32) for name in _PACKED)
        chunk_of = np.arange(len(vertex)) // CHUNK
        if len(chunks) != -(-len(vertex) // CHUNK):
            raise ValueError(f"{len(chunks)} chunks for {len(vertex)} splats")
        rest = _read_rest(ply, len(vertex))
        means = _scale_between(chunks, "position", chunk_of, unpack(position, 11, 10, 11))
        log_scales = _scale_between(chunks, "scale", chunk_of, unpack(scale, 11, 10, 11))
        rgba = unpack(color, 8, 8, 8, 8)
        rgb = _scale_between(chunks, "color", chunk_of, rgba[:, :3]) if "min_r" in chunks.dtype.names else rgba[:, :3]
    except (PlyParseError, ValueError, KeyError, TypeError, OverflowError, EOFError, MemoryError) as error:
        raise UserError(f"{path} is not a complete compressed PLY ({error}); save or download it again") from error
    note_unread(path, "ply", set(vertex.dtype.names) - {*_PACKED})
    three = (unpack(rotation, 10, 10, 10) - 0.5) * np.sqrt(2)
    rotations = whole_quaternions((rotation >> np.uint32(30)).astype(np.int64), three)
    sh = np.concatenate([((rgb - 0.5) / C0).astype(np.float32)[:, None], rest], axis=1)
    values = (x.astype(np.float32) for x in (means, log_scales, rotations, logits(rgba[:, 3], 1 / 255), sh))
    whole = Splats(*values, says_antialiasing(path), stored_offset(path), stored_enlargement(path))
    visible = np.any([vertex[name] for name in _VISIBLE], axis=0)
    return whole if visible.all() else selected(whole, visible)


def _scale_between(chunks: np.ndarray, group: str, chunk_of: np.ndarray, parts: np.ndarray) -> np.ndarray:
    ends = np.stack([np.asarray(chunks[name], np.float64) for name in _COLUMNS[group]], axis=1)[chunk_of]
    low, high = ends[:, :3], ends[:, 3:]
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
