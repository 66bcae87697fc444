"""Reading of exported files of every format, for comparison: those that the program itself does not read, too."""

import json
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from splatting.exports.formats import read_splats
from splatting.exports.scene_formats import PRIM
from splatting.exports.splats import Splats, logits
from splatting.exports.web import PROGRAM
from utils.system_utils import UserError


def read_back(path: Path) -> Splats:
    """The splats of a file that export.py wrote, in the axes of the model."""
    readers = {".glb": _read_glb, ".usdz": _read_usdz, ".sog": read_by_splat_transform}
    return readers.get(path.suffix, read_splats)(path)


def read_by_splat_transform(path: Path) -> Splats:
    """The splats of a file as PlayCanvas' program reads them, which writes them as PLY. UserError without it."""
    program = shutil.which(PROGRAM)
    if program is None:
        raise UserError(f"{path} is read by {PROGRAM}; run npm ci in tests/foreign, and add its .bin folder to PATH")
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.ply"
        subprocess.run([program, "--quiet", str(path), str(model)], check=True, capture_output=True)
        return read_splats(model)


def _read_glb(path: Path) -> Splats:
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    values = {}
    for name, index in attributes.items():
        accessor = document["accessors"][index]
        if accessor["componentType"] == 5126:
            view = document["bufferViews"][accessor["bufferView"]]
            flat = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])
            values[name.split(":")[-1]] = flat.reshape(accessor["count"], -1).copy()
    names = sorted((name for name in values if name.startswith("SH_")), key=lambda name: name.split("_")[2::2])
    sh = np.stack([values[name] for name in names], axis=1)
    rotations = np.roll(values["ROTATION"], 1, axis=1)
    return Splats(values["POSITION"], np.log(values["SCALE"]), rotations, logits(values["OPACITY"][:, 0], 1e-7), sh)


def _read_usdz(path: Path) -> Splats:
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))  # a prim does not keep its stage alive
    prim = stage.GetPrimAtPath(PRIM)

    def value(name: str) -> np.ndarray:
        return np.array(prim.GetAttribute(name).Get(), dtype=np.float32)

    turns = prim.GetAttribute("orientations").Get()
    rotations = np.array([[turn.GetReal(), *turn.GetImaginary()] for turn in turns], dtype=np.float32)
    sh = value("radiance:sphericalHarmonicsCoefficients").reshape(len(turns), -1, 3)
    return Splats(value("positions"), np.log(value("scales")), rotations, logits(value("opacities"), 1e-7), sh)
