"""Sizes of a model in each file format, seconds to write it, and what the format loses.

    python -m benchmarks.exports.sizes MODEL.ply

The loss is the PSNR between renders of the model and of what is read back from the file: one mean squared error over 5
views around the model's middle, float32 and unrounded. Those of a format without SH bands change with the view.
"""

import argparse
import json
import struct
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from arguments import OptionParser, PipelineParams
from benchmarks.harness.measuring import describe, print_table
from gaussian_renderer import render
from gaussian_renderer.free_view import free_view
from scene.cameras import MiniCam
from scene.splats.reading import read_splats
from scene.splats.splats import Splats, drawable, logits, selected
from scene.with_splats import model_of
from splatting.camera_paths.poses import facing, keyframe
from splatting.exports.formats import FORMATS
from splatting.exports.scene_formats import PRIM
from splatting.exports.sog import PROGRAM
from splatting.host.programs import find_program
from utils.system_utils import UserError, compute_device, run_cli


def read_back(path: Path) -> Splats:
    """The splats of a file that export.py wrote, in the axes of the model."""
    readers = {".glb": _read_glb, ".usdz": _read_usdz, ".sog": read_by_splat_transform}
    return readers.get(path.suffix, read_splats)(path)


def read_by_splat_transform(path: Path) -> Splats:
    """The splats of a file as PlayCanvas' program reads them, which writes them as PLY. UserError without it."""
    program = find_program(PROGRAM)
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


_FOV = 0.9  # radians, in both directions
_UP = 0.3  # height of the cameras, in distances from the middle


def orbit(means: np.ndarray, count: int, side: int) -> list[MiniCam]:
    """Square views of `side` pixels on a circle around the middle of positions (N, 3), looking at it, -y up.

    The circle's radius is 2.5 times the median distance from the middle.
    """
    middle = np.median(means, axis=0).astype(np.float64)
    radius = 2.5 * float(np.median(np.linalg.norm(means - middle, axis=1))) + 1e-6
    views = []
    for angle in np.arange(count) * 2 * np.pi / count + 0.3:
        offset = np.array([np.sin(angle), -_UP, np.cos(angle)])
        pose = keyframe(0.0, middle + radius * offset, facing(-offset, np.array([0.0, -1.0, 0.0])), 0.0)
        views.append(free_view(side, side, _FOV, pose.position, pose.wxyz, compute_device()))
    return views


VIEWS, SIDE = 5, 256


@torch.no_grad()
def renders(splats: Splats, cameras: list[MiniCam]) -> Tensor:
    """Images (V, 3, H, W) of the splats over black, with the render mode that they say."""
    pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace(antialiasing=splats.antialiasing))
    gaussians, black = model_of(splats), torch.zeros(3, device=compute_device())
    return torch.stack([render(camera, gaussians, pipe, black)["render"] for camera in cameras])


def decibels(one: Tensor, other: Tensor) -> float:
    """PSNR between images in [0, 1]; infinite if they are equal."""
    return float(-10 * (one - other).double().square().mean().log10())


def measure(model: Path) -> list[list[str]]:
    """A row for each format: ending, bytes of the file, bytes a splat, share of the PLY, seconds, PSNR in dB."""
    splats = read_splats(model)
    splats = selected(splats, drawable(splats))
    cameras = orbit(splats.means, VIEWS, SIDE)
    expected, rows = renders(splats, cameras), []
    plain = 4 * (17 + 3 * (splats.sh.shape[1] - 1))
    with tempfile.TemporaryDirectory() as folder:
        for entry in FORMATS:
            if entry.of_scene:
                continue
            path = Path(folder) / f"model{entry.ending}"
            start = time.perf_counter()
            try:
                entry.write(path, splats)
                seconds = time.perf_counter() - start
                read = read_back(path)
            except UserError as error:
                print(f"{entry.ending} is left out: {error}")
                continue
            read = Splats(**{**vars(read), "antialiasing": splats.antialiasing})
            size = path.stat().st_size / len(splats)
            loss = decibels(renders(read, cameras), expected)
            rows.append(
                [f"`{entry.ending}`", f"{size:.1f}", f"{100 * size / plain:.0f} %", f"{seconds:.2f}", f"{loss:.1f}"]
            )
    return rows


def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, help="model in a file that export.py --ply reads")
    args = parser.parse_args()
    header = ["format", "bytes a Gaussian", "of the PLY", "seconds", "dB to the model"]
    rows = measure(args.model)
    print(describe(compute_device()))
    print_table(header, rows)


if __name__ == "__main__":
    run_cli(main)
