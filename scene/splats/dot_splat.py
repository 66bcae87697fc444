"""The format .splat of antimatter15/splat: 32 bytes a splat, and colours without SH bands.

Position (3 float32), scale (3 float32, linear), colour and opacity (4 uint8), and the quaternion wxyz (4 uint8, value =
128 + 128 q). Splats that matter most, by volume times opacity, come first. Axes are the model's.
"""

import os

import numpy as np

from scene.splats.packing import rgba_bytes, to_bytes
from scene.splats.splats import Splats, logits, opacities
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write

_PACKET = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: str | os.PathLike, splats: Splats) -> None:
    """Write a .splat file, whole or not at all."""
    volume = splats.log_scales.sum(axis=1, dtype=np.float64) + np.log(np.maximum(opacities(splats), 1e-300))
    order = np.argsort(-volume, kind="stable")
    packets = np.zeros(len(splats), dtype=_PACKET)
    packets["position"] = splats.means[order]
    packets["scale"] = np.exp(splats.log_scales[order])
    packets["color"] = rgba_bytes(splats)[order]
    packets["rotation"] = to_bytes(128 + 128 * splats.rotations[order])
    with atomic_write(path) as temporary:
        temporary.write_bytes(packets.tobytes())


def read_splat(path: str | os.PathLike) -> Splats:
    """Read a .splat file. UserError if it does not consist of whole splats."""
    with open(path, "rb") as file:
        content = file.read()
    if len(content) % _PACKET.itemsize:
        raise UserError(
            f"{path} is no .splat file: its length is no multiple of {_PACKET.itemsize} bytes; export it again"
        )
    packets = np.frombuffer(content, dtype=_PACKET)
    rotations = packets["rotation"].astype(np.float32) / 128 - 1
    color = packets["color"] / 255.0
    log_scales = np.log(np.maximum(packets["scale"], np.float32(1e-35)))
    sh = ((color[:, None, :3] - 0.5) / C0).astype(np.float32)
    return Splats(packets["position"].copy(), log_scales, rotations, logits(color[:, 3], 1 / 255), sh)
