""".splat, the format of antimatter15/splat: 32 bytes a splat, colours without SH bands.

A splat is position (3 float32), scale (3 float32, linear), colour and opacity (4 uint8), and the quaternion wxyz
(4 uint8, value = 128 + 128 q). Those that matter most, by volume times opacity, come first. Axes are the model's.
"""

import os

import numpy as np

from exports.packing import to_bytes
from exports.selection import logits, opacities
from exports.splats import Splats
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write

_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all."""
    alpha = opacities(splats)
    volume = splats.log_scales.sum(axis=1, dtype=np.float64) + np.log(np.maximum(alpha, 1e-300))
    order = np.argsort(-volume, kind="stable")
    records = np.zeros(len(splats), dtype=_RECORD)
    records["position"] = splats.means[order]
    records["scale"] = np.exp(splats.log_scales[order])
    color = np.concatenate([splats.sh[:, 0] * C0 + 0.5, alpha[:, None]], axis=1)
    records["color"] = to_bytes(255 * color[order])
    records["rotation"] = to_bytes(128 + 128 * splats.rotations[order])
    with atomic_write(path) as temporary:
        temporary.write_bytes(records.tobytes())


def read_splat(path: str | os.PathLike) -> Splats:
    """Read a file of this format. UserError if it does not consist of whole splats."""
    with open(path, "rb") as file:
        content = file.read()
    if len(content) % _RECORD.itemsize:
        raise UserError(
            f"{path} is no .splat file: its length is no multiple of {_RECORD.itemsize} bytes; export it again"
        )
    records = np.frombuffer(content, dtype=_RECORD)
    rotations = records["rotation"].astype(np.float32) / 128 - 1
    color = records["color"] / 255.0
    log_scales = np.log(np.maximum(records["scale"], np.float32(1e-35)))
    sh = ((color[:, None, :3] - 0.5) / C0).astype(np.float32)
    return Splats(records["position"].copy(), log_scales, rotations, logits(color[:, 3], 1 / 255), sh)
