"""Numerical stability along a training: small stiff scenes, trained in float32 and in float64 on the CPU.

    python -m benchmarks.accuracy.stability_training [--only TEXT] [--figure PNG]

The scenes are those of workloads/stiff_trainings.py. A training is a plain loop of `rasterize`, the photometric loss
and torch's Adam at train.py's first learning rates, with neither density control nor StepGuard. It runs in float32, in
float64, and "stored": in float64 with parameters rounded to float32 after each step, so that only their storage is
float32. What guards touch is counted by the oracle's formulas, in float64, from the parameters. The exit status is 1 if
any value of a gradient is not finite.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import Gaussians, rasterize
from diff_gaussian_rasterization.reference import blend
from diff_gaussian_rasterization.reference.camera import RAY_LIMIT, camera_of, project
from diff_gaussian_rasterization.reference.colour import seen_colors
from diff_gaussian_rasterization.reference.shape import activated, compensation, project_shapes, radii
from torch import Tensor
from tqdm import tqdm

from arguments import OptimizationParams
from benchmarks.harness.measuring import describe_machine, print_table
from splatting.records.figures import save_figure
from tests.workloads import textbook
from tests.workloads.stability_cases import Parameters
from tests.workloads.stiff_trainings import EXTENT, HEIGHT, KINDS, VIEWS, WIDTH, Cameras, draw, problem
from utils.loss_utils import photometric_loss
from utils.system_utils import run_cli

STEPS, EVERY = 320, 20
SINGULAR = 1e5  # condition on the image before dilation: xx yy - xy xy would keep two digits in float32
OPTIONS = OptimizationParams(argparse.ArgumentParser()).extract(argparse.Namespace())
RATES = {"means": OPTIONS.position_lr_init * EXTENT, "opacities": OPTIONS.opacity_lr, "scales": OPTIONS.scaling_lr}
RATES |= {"rotations": OPTIONS.rotation_lr, "sh_dc": OPTIONS.feature_lr, "sh_rest": OPTIONS.feature_lr / 20}
MODES = {"float32": torch.float32, "float64": torch.float64, "stored": torch.float64}
# Trainings without a guard, or with one that acts only there: name, kinds and arguments of `train`.
CHANGED = [
    ("no dilation", ("plain", "needles", "tiny and huge"), {"dilation": 0.0}),
    ("no near plane", ("near", "at the camera"), {"near": 0.0}),
    ("antialiasing, with its floor", ("needles", "tiny and huge"), {"antialiasing": True}),
    ("learning rates 100 times as high", ("plain", "needles", "tiny and huge", "opaque"), {"rate": 100.0}),
    ("the textbook's formulas", ("needles", "tiny and huge"), {"render": textbook.render}),
]


class Training(NamedTuple):
    losses: Tensor  # (STEPS,) float64
    psnr: float  # dB, of the views held out
    rows: list[dict[str, float]]  # every EVERY iterations; the last is of the end
    wrong: int  # values of gradients that were not finite, in all iterations


def train(kind: str, mode: str, render: Callable = rasterize, rate: float = 1.0, **changes: float) -> Training:
    """Train a kind. mode: of MODES. rate: factor of all learning rates. changes: of settings."""
    (start, views, photos), dtype = problem(kind, **changes), MODES[mode]
    photos = [photo.to(dtype) for photo in photos]
    own = [v._replace(**{k: t.to(dtype) for k, t in v._asdict().items() if isinstance(t, Tensor)}) for v in views]
    leaves = {name: t.to(dtype, copy=True).requires_grad_() for name, t in start.items()}
    adam = torch.optim.Adam([{"params": [leaves[name]], "lr": rate * RATES[name]} for name in RATES], eps=1e-15)
    losses, rows, wrong = [], [], 0
    for step in range(STEPS):
        if step % EVERY == 0:
            rows.append(count_guarded(leaves, views[:VIEWS]) | dict.fromkeys(RATES, 0.0))
        k = 3 * step % VIEWS  # each view once in VIEWS steps
        loss, _ = photometric_loss(draw(leaves, own[k], render), photos[k], OPTIONS.lambda_dssim)
        adam.zero_grad()
        loss.backward()
        for name, leaf in leaves.items():
            wrong += int((~leaf.grad.isfinite()).sum())
            rows[-1][name] = max(rows[-1][name], float(leaf.grad.flatten(1).norm(dim=1).max()))
        adam.step()
        for leaf in leaves.values() if mode == "stored" else ():
            leaf.data.copy_(leaf.data.float())
        losses.append(float(loss.detach()))
        rows[-1]["loss"] = sum(losses[-VIEWS:]) / len(losses[-VIEWS:])
    rows.append(count_guarded(leaves, views[:VIEWS]))
    with torch.no_grad():
        errors = [draw(leaves, v, render).clamp(0, 1) - p for v, p in zip(own[VIEWS:], photos[VIEWS:], strict=True)]
    psnr = sum(-10 * math.log10(float(error.double().square().mean())) for error in errors) / len(errors)
    return Training(torch.tensor(losses, dtype=torch.float64), psnr, rows, wrong)


@torch.no_grad()
def count_guarded(parameters: Parameters, views: Cameras) -> dict[str, float]:
    """Conditions of the covariances, and how many Gaussians, or pixels, a guard touches in any of the views."""
    gaussians = activated(Gaussians(**{name: t.detach().double() for name, t in parameters.items()}))
    touched: dict[str, Tensor] = {}
    pixels = {"pixels with alpha capped at 0.99": 0, "pixels ended at T < 1e-4": 0}
    for view in views:
        camera = camera_of(view)
        points = project(gaussians.means, torch.zeros_like(gaussians.means), camera)
        ellipses = project_shapes(gaussians, points, camera, 1.0)
        opacity = gaussians.opacities[:, 0] * (compensation(ellipses) if view.antialiasing else 1)
        colors = seen_colors(gaussians, camera, 3)
        xx, xy, yy = ellipses.covariance()
        largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy) - camera.dilation
        smallest, drawn = ellipses.undilated / largest, radii(points, ellipses, camera) > 0
        ray = (points.view[:, :2] / points.depth[:, None]).abs() / camera.tangents
        marks = {
            "behind the near plane, z > 0": (points.view[:, 2] > 0) & ~points.in_front,
            "ray clamped to 1.3 half images": drawn & (ray > RAY_LIMIT).any(1),
            "narrower than the dilation": drawn & (smallest < 0.3),
            "at the antialiasing's floor, if it is on": drawn & (compensation(ellipses) < 0.00501),
            "fainter than 1/255": drawn & (opacity < blend.LEAST_ALPHA),
            "a colour clamped at 0": drawn & (colors == 0).any(1),
            "not finite, or over 1e18 px": ~((xx + yy < 1e36) & (colors.sum(1) + opacity).isfinite()),
            "near singular": drawn & (largest > SINGULAR * smallest),
        }
        touched = {name: touched.get(name, False) | mark for name, mark in marks.items()}
        splats = blend.nearest_first(points, ellipses, None, opacity, colors, 0)
        alpha = blend.alphas(splats, range(HEIGHT), WIDTH)
        left = (1 - torch.where(alpha < blend.LEAST_ALPHA, 0.0, alpha.clamp(max=blend.LARGEST_ALPHA))).cumprod(0)
        for name, which in zip(pixels, (alpha > blend.LARGEST_ALPHA, left < blend.LEAST_TRANSMITTANCE), strict=True):
            pixels[name] += int(which.any(0).sum())
    square = gaussians.scales.square()
    condition = (square.amax(1) / square.amin(1)).nan_to_num(nan=0)
    found = {"median": condition.median(), "largest": condition.max(), "eigenvalue": square.nan_to_num(math.inf).min()}
    found |= {name: mark.sum() for name, mark in touched.items()} | pixels
    return {name: float(value) for name, value in found.items()}


def summary(kind: str, runs: dict[str, Training]) -> list[str]:
    """Return a row of the table: a kind's losses, PSNR, differences to float64, and shapes at the start and the end.

    runs: trainings of the kind, by mode.
    """
    f, exact, stored = (runs[mode] for mode in MODES)
    first, last = f.rows[0], f.rows[-1]
    apart = [f"{float((r.losses - exact.losses)[-VIEWS:].mean()):+.0e}" for r in (f, stored)]
    decibel = [f"{r.psnr - exact.psnr:+.0e}" for r in (f, stored)]
    spans = [f"{first[n]:.3g} to {last[n]:.3g}" for n in ("median", "largest", "eigenvalue", "near singular")]
    losses = f"{first['loss']:.3f} to {f.rows[-2]['loss']:.3f}"
    return [kind, losses, *apart, f"{exact.psnr:.2f}", *decibel, *spans, str(f.wrong + exact.wrong)]


def print_course(kind: str, runs: dict[str, Training]) -> None:
    """Print what was every EVERY iterations: losses and gradients until then, shapes at the start of these."""
    f, exact, stored = (runs[mode] for mode in MODES)
    numbers = ["loss", *RATES, "median", "largest", "eigenvalue", "near singular"]
    rows = []
    for k, row in enumerate(f.rows[:-1]):
        part = slice(EVERY * k, EVERY * (k + 1))
        apart = [f"{float((r.losses - exact.losses)[part].abs().max()):.0e}" for r in (f, stored)]
        rows.append([str(part.stop), *apart, *(f"{row[name]:.3g}" for name in numbers)])
    print(f"\n{kind}: largest |difference| of the loss to float64, largest gradients, conditions in float32\n")
    print_table(["until", "float32", "stored", *numbers], rows)


def changed_rows(name: str, kind: str, options: dict, usual: Training) -> list[str]:
    run, exact = train(kind, "float32", **options), train(kind, "float64", **options | {"render": rasterize})
    largest = max(row[attribute] for row in run.rows[:-1] for attribute in RATES)
    apart = [f"{run.psnr:.2f}", f"{usual.psnr:.2f}", f"{run.psnr - exact.psnr:+.0e}"]
    return [name, kind, f"{run.rows[-2]['loss']:.3f}", *apart, f"{largest:.0e}", str(run.wrong + exact.wrong)]


def draw_figure(path: Path, found: dict[str, dict[str, Training]]) -> None:
    """Draw loss, its difference to float64, conditions and gradients against iterations, a colour for each kind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6.5), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    labels = [
        "loss, float32",
        "|loss - float64's|: float32, dashed: stored",
        "condition in space: median, dashed: largest",
    ]
    for panel, label in zip(panels, [*labels, "largest gradient of means"], strict=True):
        panel.set(xlabel="iteration", ylabel=label, yscale="log")
        panel.grid(alpha=0.3)
    ends = range(EVERY, STEPS + 1, EVERY)
    for number, (kind, runs) in enumerate(found.items()):
        f, exact, stored = (runs[mode] for mode in MODES)
        apart = [(r.losses - exact.losses).abs().view(-1, EVERY).amax(1).clamp(min=1e-12) for r in (f, stored)]
        loss, median, most, means = ([r[n] for r in f.rows[:-1]] for n in ("loss", "median", "largest", "means"))
        solid, dashed = (loss, apart[0], median, means), (None, apart[1], most, None)
        for panel, line, other in zip(panels, solid, dashed, strict=True):
            panel.plot(ends, line, color=f"C{number}", label=kind, linewidth=1.2)
            if other is not None:
                panel.plot(ends, other, color=f"C{number}", linestyle="--", linewidth=0.9)
    panels[0].legend(fontsize="small")
    save_figure(figure, path, 60)


def main() -> None:
    """Train all kinds in all modes, print the tables, and exit with 1 if a number was not finite."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="train the kinds whose name contains this (default: all)")
    parser.add_argument("--figure", type=Path, help="image file to write")
    args = parser.parse_args()
    print(describe_machine())
    kinds = [kind for kind in KINDS if args.only in kind]
    found = {kind: {mode: train(kind, mode) for mode in MODES} for kind in tqdm(kinds, unit="kind", leave=False)}
    for kind, runs in found.items():
        print_course(kind, runs)
    print("\nAll kinds: loss, its difference to float64 at the end, PSNR and its difference, shapes in float32\n")
    apart = ["float32", "stored", "dB, float64", "float32, dB", "stored, dB"]
    shapes = ["condition, median", "largest", "smallest eigenvalue", "near singular", "not finite"]
    summaries = [summary(kind, runs) for kind, runs in found.items()]
    print_table(["kind", "loss", *apart, *shapes], summaries)
    print("\nTouched by guards, of 200 Gaussians or of the pixels of 8 views, at the start and the end (float32)\n")
    names = [name for name in next(iter(found.values()))["float32"].rows[-1] if " " in name] if found else []
    ends = [(runs["float32"].rows[0], runs["float32"].rows[-1]) for runs in found.values()]
    print_table(["guard", *found], [[n, *(f"{a[n]:.0f}, {b[n]:.0f}" for a, b in ends)] for n in names])
    print("\nWithout a guard, or with more: PSNR in float32, as usual, and float32 - float64\n")
    cases = [(name, kind, options) for name, of, options in CHANGED for kind in of if kind in found]
    rows = [changed_rows(*case, found[case[1]]["float32"]) for case in tqdm(cases, leave=False)]
    print_table(["change", "kind", "loss", "dB", "usual", "less float64", "largest gradient", "not finite"], rows)
    if args.figure:
        draw_figure(args.figure, found)
    if any(row[-1] != "0" for row in [*summaries, *rows]):
        raise SystemExit(1)


if __name__ == "__main__":
    run_cli(main)
