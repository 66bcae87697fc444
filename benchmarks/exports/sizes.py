"""Sizes of a model in each file format, seconds to write it, and what the format loses.

    python -m benchmarks.exports.sizes MODEL.ply

The loss is the PSNR between renders of the model and of what is read back from the file: one mean squared error over 5
views around the model's middle, float32 and unrounded. Those of a format without SH bands change with the view.
"""

import argparse
import tempfile
import time
from pathlib import Path

import torch
from torch import Tensor

from arguments import OptionParser, PipelineParams
from benchmarks.exports.read_back import read_back
from benchmarks.harness.environment import describe, print_table
from benchmarks.workloads.orbit import orbit
from gaussian_renderer import render
from scene.cameras import MiniCam
from splatting.exports.formats import FORMATS, read_splats
from splatting.exports.in_scene import model_of
from splatting.exports.splats import Splats, drawable, selected
from utils.system_utils import UserError, compute_device, run_cli

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
    for camera in cameras:
        for name in ("world_view_transform", "full_proj_transform", "camera_center"):
            setattr(camera, name, getattr(camera, name).to(compute_device()))
    wanted, rows = renders(splats, cameras), []
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
            loss = decibels(renders(read, cameras), wanted)
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
