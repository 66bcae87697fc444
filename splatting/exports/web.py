"""Formats for the web: .splat, and SOG.

A .splat file, the format of antimatter15/splat, has 32 bytes a splat, and colours without SH bands: position (3
float32), scale (3 float32, linear), colour and opacity (4 uint8), and the quaternion wxyz (4 uint8, value = 128 +
128 q). Splats that matter most, by volume times opacity, come first. Axes are the model's.

SOG, the format of PlayCanvas, is written by its own program splat-transform, which needs Node.
"""

import os
import shutil
import subprocess
import zipfile
from pathlib import Path
from urllib.parse import quote

import numpy as np

from splatting.exports.packing import rgba_bytes, to_bytes
from splatting.exports.ply import write_plain_ply
from splatting.exports.splats import Splats, logits, opacities
from utils.sh_utils import C0
from utils.system_utils import UserError, atomic_write, temporary_folder

_PACKET = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
PROGRAM = "splat-transform"
# The program clusters the SH bands from a random start and has no option for a seed, so it gets a Math.random with one
# (xorshift, Marsaglia 2003). Without it 600 Gaussians with random SH bands came out at 34 to 39 dB by chance.
_SEEDED = "let s=1;Math.random=()=>{s^=s<<13;s^=s>>>17;s^=s<<5;return(s>>>0)/2**32}"


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


def find_program(path: str | os.PathLike) -> str:
    """The program that a file of this name needs. UserError without it."""
    program = shutil.which(PROGRAM) or shutil.which(PROGRAM, path="node_modules/.bin")
    if program is None:
        raise UserError(f"{path} needs {PROGRAM}; install Node, then run npm install -g @playcanvas/splat-transform")
    return program


def write_sog(path: str | os.PathLike, splats: Splats) -> None:
    """Write a SOG file, whole or not at all. UserError without splat-transform, on PATH or in ./node_modules."""
    program = find_program(path)
    if not len(splats):
        raise UserError(f"{path} would have no splats, which {PROGRAM} does not write; choose another format")
    with temporary_folder() as folder, atomic_write(path) as temporary:
        model, packed = folder / "model.ply", folder / "model.sog"
        write_plain_ply(model, splats)
        # Without a GPU, as its results differ from machine to machine.
        options = [os.environ.get("NODE_OPTIONS", ""), f"--import=data:text/javascript,{quote(_SEEDED)}"]
        environment = {**os.environ, "NODE_OPTIONS": " ".join(options).strip()}
        command = [program, "--quiet", "--overwrite", "--gpu", "cpu", str(model), str(packed)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        if done.returncode or not packed.is_file():
            said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
            raise UserError(f"{PROGRAM} could not write {path} ({said[-1]}); choose another format, or update it")
        _copy_without_dates(packed, temporary)


def _copy_without_dates(source: Path, target: Path) -> None:
    """Copy a ZIP file. Its members keep their order and bytes, and get the date that a ZipInfo has by default."""
    with zipfile.ZipFile(source) as read, zipfile.ZipFile(target, "w") as written:
        for member in read.infolist():
            written.writestr(zipfile.ZipInfo(member.filename), read.read(member))
