"""Stages of a training iteration on the CPU, on views of a trained model, in one or more checkouts by turns.

    python -m benchmarks.kernels.cpu_stages -m MODEL [--iteration N] [--checkouts . OLDER] [--rounds N]

Each checkout has its own .venv, or runs in this one's. Its process stays; in each round every process does one
iteration on the same view, so that a busy machine slows all alike. Prints the fewest and the median milliseconds of
each stage, and the median ratio to the last checkout. `forward` is one call that does project, bin and blend, and
`backward` one for blend_vjp and project_vjp: there, binning takes over what projection knows about tiles. The variable
GS_ISA chooses an instruction set.

A second table has the pixels that an instance evaluates and blends, for vectors of 8 and of 16 pixels of a row, beside
those of squares.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import torch

from arguments import ModelParams, OptionParser, get_combined_args
from benchmarks.harness.environment import describe, print_table
from benchmarks.kernels.fragments import fragments
from benchmarks.kernels.views import view_arguments
from scene.saved_model import load_saved
from scene.scene import Scene
from utils.system_utils import compute_device, run_cli

PROGRAM = Path(__file__).with_name("cpu_stages_program.py")
VIEWS = 4
SHAPES = ((16, 1), (8, 1), (8, 2), (4, 4), (8, 8))  # width, height


class Checkout:
    """A process that does iterations with the code of a folder."""

    def __init__(self, folder: Path, views: Path) -> None:
        own = folder / ".venv" / "bin" / "python"
        program = PROGRAM.read_text() + "\n\nmain()\n"
        self._process = subprocess.Popen(
            [str(own) if own.exists() else sys.executable, "-c", program, str(views)],
            env=os.environ | {"PYTHONPATH": str(folder)},
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.took: list[dict[str, float]] = []

    def iterate(self, view: int) -> dict[str, float]:
        print(view, file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()


def save_views(scene: Scene, file: Path) -> int:
    """Write arguments and photo of some training views; return their number."""
    cameras = scene.getTrainCameras()
    cameras = cameras[:: max(1, len(cameras) // VIEWS)][:VIEWS]
    model = scene.gaussians
    torch.save([(_detached(view_arguments(c, model)), c.original_image.clone()) for c in cameras], file)
    return len(cameras)


def _detached(arguments: tuple) -> tuple:
    return tuple(a.detach().contiguous() if isinstance(a, torch.Tensor) else a for a in arguments)


def measure(checkouts: list[Checkout], views: int, rounds: int) -> None:
    for view in range(views):  # warm-up
        for checkout in checkouts:
            checkout.iterate(view)
    for turn in range(rounds):
        for checkout in checkouts:
            checkout.took.append(checkout.iterate(turn % views))


def rows_of(checkouts: list[Checkout]) -> list[list[str]]:
    rows = []
    for stage in checkouts[0].took[0]:
        times = [[took[stage] for took in checkout.took] for checkout in checkouts]
        ratios = [median(a / b for a, b in zip(own, times[-1], strict=True)) for own in times]
        cells = [f"{min(own):.2f}, {median(own):.2f}, {r:.2f}" for own, r in zip(times, ratios, strict=True)]
        rows.append([stage, *cells])
    return rows


def count(file: Path) -> list[list[str]]:
    """Count the pixels of an instance, means over the views."""
    ops, totals, listed, reached = torch.ops.diff_gaussian_rasterization, {}, 0, 0
    for arguments, photo in torch.load(file):
        splats, depths, rects, tile_counts, _ = ops.project(*arguments)
        size = photo.shape[-2:]
        instances, ranges, _, _ = ops.bin(splats, depths, rects, tile_counts, *size, False)
        last = ops.blend(splats, instances, ranges, torch.zeros(3), *size, False, True)[3]
        found = fragments(splats, instances, ranges, last, SHAPES)
        listed, reached = listed + len(instances), reached + int((tile_counts > 0).sum())
        for shape, per_pixel in found.items():
            totals[shape] = totals.get(shape, 0) + per_pixel * last.numel()
    rows = [["tiles a splat", f"{listed / reached:.2f}"]]
    return rows + [[f"pixels an instance, {shape}", f"{total / listed:.1f}"] for shape, total in totals.items()]


@torch.no_grad()
def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    model_params = ModelParams(parser, sentinel=True)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to load (-1: the highest)")
    parser.add_argument("--checkouts", type=Path, nargs="+", default=[Path()], help="folders of the code (default: .)")
    parser.add_argument("--rounds", type=int, default=40, help="iterations of each checkout (default: 40)")
    args = get_combined_args(parser)
    print(describe(compute_device()))
    scene = load_saved(model_params.extract(args), args.iteration, args.typed_sh_degree)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "views.pt")
        views = save_views(scene, file)
        checkouts = [Checkout(path.resolve(), file) for path in args.checkouts]
        measure(checkouts, views, args.rounds)
        for checkout in checkouts:
            checkout.close()
        print_table(["ms: fewest, median, ratio", *map(str, args.checkouts)], rows_of(checkouts))
        print()
        print_table([f"{scene.model_path}, {len(scene.gaussians):,} Gaussians", ""], count(file))


if __name__ == "__main__":
    run_cli(main)
