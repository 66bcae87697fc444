"""PLY with float32 properties: the reference's columns, and comments that say what they mean."""

import contextlib
import math
import os

import numpy as np
import torch

from exports.splats import Splats
from scene.gaussians.ply import offset_comments, read_ply, read_vertices, write_ply
from scene.readers.world_offset import origin_near
from utils.files.model_json import LARGEST_OFFSET
from utils.files.ply_header import header_lines
from utils.system_utils import UserError

AXES = "axes x right, y down, z forward (COLMAP)"


def comments(splats: Splats) -> list[str]:
    """Comments of our PLY files. Brush writes SplatRenderMode, and Postshot antialiased; viewers know both."""
    return [
        AXES,
        f"SplatRenderMode: {'mip' if splats.antialiasing else 'default'}",
        f"antialiased {splats.antialiasing:d}",
        *offset_comments(splats.world_offset),
    ]


def says_antialiasing(path: str | os.PathLike) -> bool:
    """Whether the comments of a PLY say that its splats were trained with antialiasing; the last one counts."""
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
                    return _checked(offset, path)
    return 0.0, 0.0, 0.0


def _checked(offset: tuple[float, float, float], path: str | os.PathLike) -> tuple[float, float, float]:
    farthest = max(map(abs, offset))
    if farthest > LARGEST_OFFSET:
        raise UserError(
            f"{path} lies {farthest:.3g} from the origin of its world, and {LARGEST_OFFSET:g} is the most; correct its "
            "positions and its comment world_offset"
        )
    return offset


def write_plain_ply(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all."""
    sh = torch.from_numpy(splats.sh)
    rows = {
        "xyz": torch.from_numpy(splats.means),
        "f_dc": sh[:, :1],
        "f_rest": sh[:, 1:],
        "opacity": torch.from_numpy(splats.opacity_logits)[:, None],
        "scaling": torch.from_numpy(splats.log_scales),
        "rotation": torch.from_numpy(splats.rotations),
    }
    write_ply(path, rows, splats.sh_degree, comments=comments(splats))


def read_plain_ply(path: str | os.PathLike) -> Splats:
    """Read a Gaussian PLY of any tool. UserError as from scene/gaussians/ply.py.

    Doubles far from their origin, as of scene/export_world.py, become relative to one that is near them.
    """
    rows = {name: values.numpy() for name, values in read_ply(path, None).items()}
    offset = stored_offset(path)
    if any(line.split() in (["property", "double", "x"], ["property", "float64", "x"]) for line in header_lines(path)):
        rows["xyz"], origin = _near_origin(path, rows["xyz"])
        offset = _checked(tuple((origin + offset).tolist()), path)
    sh = torch.cat([torch.from_numpy(rows["f_dc"]), torch.from_numpy(rows["f_rest"])], dim=1).numpy()
    values = (rows["xyz"], rows["scaling"], rows["rotation"], rows["opacity"][:, 0], sh)
    return Splats(*values, antialiasing=says_antialiasing(path), world_offset=offset)


def _near_origin(path: str | os.PathLike, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The positions (N,3) of a PLY of doubles as float32, and their origin (3,), which is zero unless they are far."""
    vertices = read_vertices(path)
    places = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
    finite = places[np.isfinite(places).all(axis=1)]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(3)
    extent = float(np.median(np.linalg.norm(finite - middle, axis=1))) if len(finite) else 0.0
    origin = origin_near(middle, extent) if extent else np.zeros(3)
    if not origin.any():
        return means, origin
    print(f"{path}: positions are taken relative to {' '.join(map(repr, origin.tolist()))}, for float32's sake")
    return (places - origin).astype(np.float32), origin
