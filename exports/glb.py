"""GLB: binary glTF 2.0 with the Khronos extension KHR_gaussian_splatting, all attributes but a fallback colour float32.

Splats are points with attributes: linear scales, opacities in [0, 1], quaternions xyzw, and each SH coefficient as an
attribute. glTF's y is up. The values are those of the model, in COLMAP's axes, and the node turns them half around x.
COLOR_0 shows programs without the extension a coloured point cloud.
"""

import json
import os
import struct

import numpy as np

from exports.packing import to_bytes
from exports.selection import opacities
from exports.splats import Splats
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write

EXTENSION = "KHR_gaussian_splatting"
LARGEST = 2**32 - 1  # bytes: the header has 32 bits for them
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all. UserError if it is too large.

    Without splats it has a node without a mesh, as glTF has no empty one.
    """
    attributes = _attributes(splats) if len(splats) else {}
    sizes = [values.nbytes for values in attributes.values()]
    document = _document(attributes, sizes, splats.antialiasing)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    length = 12 + len(chunks) + (8 + sum(sizes) if attributes else 0)
    if length > LARGEST:
        raise UserError(
            f"{path} would have {length / 1e9:.1f} GB, and a GLB has at most {LARGEST / 1e9:.1f}; leave Gaussians out "
            "by --max_splats, or bands by --sh_degree"
        )
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length) + chunks)
        if attributes:
            file.write(struct.pack("<I4s", sum(sizes), b"BIN\0"))
        for values in attributes.values():  # one by one, as all of them together take much memory
            file.write(np.ascontiguousarray(values))


def _attributes(splats: Splats) -> dict[str, np.ndarray]:
    alpha = opacities(splats)
    color = np.concatenate([splats.sh[:, 0] * C0 + 0.5, alpha[:, None]], axis=1)
    values = {
        "POSITION": splats.means,
        "COLOR_0": to_bytes(255 * color),
        f"{EXTENSION}:ROTATION": np.roll(splats.rotations, -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(splats.log_scales),
        f"{EXTENSION}:OPACITY": alpha[:, None],
    }
    for degree in range(splats.sh_degree + 1):
        for index in range(2 * degree + 1):
            values[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"] = splats.sh[:, degree**2 + index]
    return {name: x if x.dtype == np.uint8 else x.astype("<f4") for name, x in values.items()}


def _document(attributes: dict[str, np.ndarray], sizes: list[int], antialiasing: bool) -> dict:
    node = {"name": "splats", "rotation": [1, 0, 0, 0]}
    document = {
        "asset": {"version": "2.0", "generator": "export.py", "extras": {"antialiasing": antialiasing}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
    }
    if not attributes:
        del document["extensionsUsed"]
        return document
    node["mesh"] = 0
    starts = np.cumsum([0, *sizes])
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: settings},
    }
    return document | {
        "meshes": [{"primitives": [primitive]}],
        "accessors": [_accessor(index, name, values) for index, (name, values) in enumerate(attributes.items())],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": size, "target": _ARRAY_BUFFER}
            for start, size in zip(starts, sizes, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }


def _accessor(index: int, name: str, values: np.ndarray) -> dict:
    is_byte = values.dtype == np.uint8
    accessor = {
        "bufferView": index,
        "componentType": _UNSIGNED_BYTE if is_byte else _FLOAT,
        "count": len(values),
        "type": _KINDS[values.shape[1]],
    }
    if is_byte:
        accessor["normalized"] = True
    if name == "POSITION":  # glTF asks for its bounds
        accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    return accessor
