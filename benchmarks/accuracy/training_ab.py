"""The same small trainings with the textbook's formulas, with ours in float32, and with ours in float64.

    python -m benchmarks.accuracy.training_ab [--iterations 400] [--write docs/results/stability.md]

Each scene has some 60 Gaussians, seen from 8 sides on 64 x 48 px; every fourth view is for testing. The photos are the
float64 oracle's. Training starts from disturbed Gaussians. Loss and learning rates are train.py's, but positions learn
ten times as fast, since so few steps are taken. There is no density control, and Adam is PyTorch's: renderer and dtype
are all that differs.

A Gaussian is lost to NaN when one of its values is no longer finite; it is not rendered from then on. It is culled if
its opacity ends below 0.005, as density control does. A step is lost if its loss is not finite; it changes nothing.
PSNR is the mean over the test views, drawn by the renderer that trained; a pixel that is not finite counts as 0.
"""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, reference
from torch import Generator, Tensor
from tqdm import tqdm

from benchmarks.accuracy.stability import CPU_DOUBLE, CPU_FLOAT, TEXTBOOK, Backend
from benchmarks.harness.environment import describe, print_table, table
from benchmarks.harness.page import check_marks, write_tables
from benchmarks.workloads.splat_scenes import frustum, settings
from utils.loss_utils import ssim
from utils.system_utils import run_cli

WIDTH, HEIGHT, COUNT = 64, 48, 60
VIEWS, HELD_OUT = 8, 4
PIVOT = torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)  # that the cameras turn around
FAR = torch.tensor([1e5, 1e5, 0.0], dtype=torch.float64)
RATES = {"means": 1.6e-3, "opacities": 0.025, "scales": 0.005, "rotations": 0.001, "sh_dc": 0.0025, "sh_rest": 0.000125}
CULLED = 0.005  # opacity
PART = "training"  # of the page
BACKENDS = (TEXTBOOK, CPU_FLOAT, CPU_DOUBLE)


class Scene(NamedTuple):
    """Photos, their cameras, and the Gaussians that a training starts from."""

    views: list[GaussianRasterizationSettings]
    photos: list[Tensor]  # (3, H, W) float64
    start: dict[str, Tensor]  # raw, float32


class Outcome(NamedTuple):
    """What a training ended with."""

    psnr_at_start: float  # dB
    psnr: float
    lost: int  # Gaussians with a value that is not finite
    culled: int
    steps_lost: int
    seconds: float


def _camera(angle: float, offset: Tensor, antialiasing: bool) -> GaussianRasterizationSettings:
    """Look at the pivot from `angle` radians aside, in a world that is shifted by `offset`."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = math.cos(angle), math.sin(angle), -math.sin(angle), math.cos(angle)
    view = turn.clone()
    view[:3, 3] = PIVOT - turn[:3, :3] @ (PIVOT + offset)
    return settings(WIDTH, HEIGHT, view=view, antialiasing=antialiasing)


def _scene(
    sigma: float,
    change: Callable[[dict[str, Tensor], Generator], None] | None = None,
    offset: Tensor | None = None,
    turned: float = 0.1,
    antialiasing: bool = False,
) -> Scene:
    """Make a scene. change: of the true Gaussians, in place; turned: disturbance of the rotations at the start."""
    offset = torch.zeros(3, dtype=torch.float64) if offset is None else offset
    truth = {name: values.double() for name, values in frustum(COUNT, WIDTH, HEIGHT, sigma, seed=5).parameters.items()}
    g = Generator().manual_seed(6)
    if change:
        change(truth, g)
    views = [_camera(0.5 * (2 * i / (VIEWS - 1) - 1), offset, antialiasing) for i in range(VIEWS)]
    placed = truth | {"means": truth["means"] + offset}
    with torch.no_grad():
        photos = [_draw(reference.render, placed, view) for view in views]
    far = {"means": 0.05, "opacities": 0.5, "scales": 0.2, "rotations": turned, "sh_dc": 0.5, "sh_rest": 0.05}
    start = {
        name: values + far[name] * torch.randn(values.shape, generator=g, dtype=torch.float64)
        for name, values in placed.items()
    }
    return Scene(views, photos, {name: values.float() for name, values in start.items()})


def _needles(low: float, high: float) -> Callable[[dict[str, Tensor], Generator], None]:
    """Make needles of standard deviation low to high px, 4e-3 px wide."""

    def change(truth: dict[str, Tensor], g: Generator) -> None:
        of_four_px = truth["scales"].mean(1)
        lengths = low / 4 * (high / low) ** torch.rand(COUNT, generator=g, dtype=torch.float64)
        truth["scales"][:, 0] = of_four_px + lengths.log()
        truth["scales"][:, 1:] = of_four_px[:, None] + math.log(1e-3)
        truth["opacities"] += 1

    return change


def _brighten(truth: dict[str, Tensor], _: Generator) -> None:
    truth["opacities"] += 4


KINDS: dict[str, Callable[[], Scene]] = {
    "ordinary": lambda: _scene(4.0),
    "needles of 20 to 200 px": lambda: _scene(4.0, _needles(20, 200), turned=0.02),
    "needles of 300 to 2,000 px": lambda: _scene(4.0, _needles(300, 2000), turned=0.002),
    "the same, antialiased": lambda: _scene(4.0, _needles(300, 2000), turned=0.002, antialiasing=True),
    "far from the origin, at 1e5": lambda: _scene(4.0, offset=FAR),
    "tiny scale, a thousandth of a pixel": lambda: _scene(1e-3, _brighten),
}


def _draw(render: Callable, parameters: dict[str, Tensor], view: GaussianRasterizationSettings) -> Tensor:
    named = {name: values for name, values in parameters.items() if name not in ("means", "opacities")}
    means = parameters["means"]
    return render(means, torch.zeros_like(means), parameters["opacities"], view, raw=True, **named).color


def _finite_rows(leaves: dict[str, Tensor]) -> Tensor:
    """(N,) bool: Gaussians all of whose values are finite."""
    return torch.stack([values.detach().flatten(1).isfinite().all(1) for values in leaves.values()]).all(0)


def _psnr(scene: Scene, leaves: dict[str, Tensor], backend: Backend) -> float:
    alive = _finite_rows(leaves)
    scores = []
    for view, photo in list(zip(scene.views, scene.photos, strict=True))[::HELD_OUT]:
        with torch.no_grad():
            image = _draw(backend.render, {name: values[alive] for name, values in leaves.items()}, view)
        error = image.double().nan_to_num(0.0, 0.0, 0.0).clamp(0, 1) - photo.clamp(0, 1)
        scores.append(-10 * float(error.square().mean().log10()))
    return sum(scores) / len(scores)


def train(scene: Scene, backend: Backend, iterations: int) -> Outcome:
    """Train a scene with a renderer, in its dtype."""
    leaves = {name: values.to(backend.dtype).clone().requires_grad_() for name, values in scene.start.items()}
    optimizer = torch.optim.Adam(
        [{"params": [values], "lr": RATES[name]} for name, values in leaves.items()], eps=1e-15
    )
    trained = [i for i in range(VIEWS) if i % HELD_OUT]
    targets = [photo.clamp(0, 1).to(backend.dtype) for photo in scene.photos]
    before, steps_lost = _psnr(scene, leaves, backend), 0
    start = time.perf_counter()
    for iteration in range(iterations):
        index = trained[iteration % len(trained)]
        alive = _finite_rows(leaves)
        image = _draw(backend.render, {name: v[alive] for name, v in leaves.items()}, scene.views[index]).clamp(0, 1)
        loss = 0.8 * (image - targets[index]).abs().mean() + 0.2 * (1 - ssim(image, targets[index]))
        optimizer.zero_grad()
        if not loss.isfinite():
            steps_lost += 1
            continue
        loss.backward()
        optimizer.step()
    seconds = time.perf_counter() - start
    alive = _finite_rows(leaves)
    culled = int((leaves["opacities"].detach()[alive, 0].sigmoid() < CULLED).sum())
    return Outcome(before, _psnr(scene, leaves, backend), int((~alive).sum()), culled, steps_lost, seconds)


HEADER = ["scene", "formulas", "PSNR at the start", "PSNR", "lost to NaN", "culled", "steps lost", "seconds"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=400, help="steps of each training (default: 400)")
    parser.add_argument("--write", type=Path, help="page whose table of trainings to replace (default: only print)")
    args = parser.parse_args()
    if args.write:
        check_marks(args.write, PART)
    rows = []
    for kind, make in tqdm(KINDS.items(), leave=False):
        scene = make()
        for backend in BACKENDS:
            it = train(scene, backend, args.iterations)
            rows.append([kind, backend.name, f"{it.psnr_at_start:.2f}", f"{it.psnr:.2f}", f"{it.lost} of {COUNT}"])
            rows[-1] += [str(it.culled), str(it.steps_lost), f"{it.seconds:.1f}"]
    machine = f"{describe()}, {args.iterations} iterations"
    print(machine)
    print_table(HEADER, rows)
    if args.write:
        write_tables(args.write, PART, ["", f"{machine}.", "", *table(HEADER, rows), ""])


if __name__ == "__main__":
    run_cli(main)
