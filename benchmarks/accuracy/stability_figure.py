"""Figure of error and milliseconds against condition: axis ratio, length in pixels, depth.

    python -m benchmarks.accuracy.stability_figure docs/stability.png

Ours and the textbook's formulas (workloads/textbook.py), in float32 and float64, on stiff Gaussians among ordinary
ones. Errors are those of benchmarks.accuracy.stability: of the stiff part, the worst of the planes and the worst of all
gradients, against the float64 oracle. The grey line is what one rounding of the inputs to float32 does. An error that
is not finite is drawn at the top of its panel. Milliseconds are of forward and backward; a case has some 70 Gaussians
on 75 x 53 px, so they are mostly overhead, and show whether a stiff case costs more.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from tqdm import tqdm

from benchmarks.accuracy.runs import CPU_DOUBLE, CPU_FLOAT, TEXTBOOK
from benchmarks.accuracy.stability import ROUNDING, Judged, Result
from benchmarks.harness.measuring import describe_machine
from splatting.records.figures import save_figure
from tests.workloads.stability_cases import PLAIN, Case, Problem, make_depths, make_needles, needles
from utils.system_utils import run_cli

TEXTBOOK_DOUBLE = TEXTBOOK._replace(name="textbook float64", dtype=torch.float64)
BACKENDS = (CPU_FLOAT, CPU_DOUBLE, TEXTBOOK, TEXTBOOK_DOUBLE)
STYLES = {
    CPU_FLOAT.name: {"color": "#0072B2", "marker": "o"},
    CPU_DOUBLE.name: {"color": "#0072B2", "marker": "o", "linestyle": "--", "markerfacecolor": "white"},
    TEXTBOOK.name: {"color": "#D55E00", "marker": "s"},
    TEXTBOOK_DOUBLE.name: {"color": "#D55E00", "marker": "s", "linestyle": "--", "markerfacecolor": "white"},
    ROUNDING: {"color": "gray", "linewidth": 3, "alpha": 0.4},
}
ROWS = {"image": "error of the image", "gradients": "error of the gradients", "milliseconds": "ms, forward + backward"}


class Sweep(NamedTuple):
    """A condition that gets worse from value to value."""

    name: str
    values: tuple[float, ...]
    make: Callable[[float], Callable[[torch.Generator], Problem]]
    cut: Callable[[float], float]  # pixels this near to a cut-off do not count (`Case.cut`)


SWEEPS = [
    Sweep("axis ratio of needles", (1, 10, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7), needles, lambda _: 1e-4),
    Sweep(
        "length of needles, px",
        (10, 30, 100, 300, 1e3, 3e3, 1e4, 3e4, 1e5),
        lambda length: make_needles(length, 1.2 * length),
        lambda length: 1e-4 if length < 300 else 2e-3 if length < 5e3 else 0.1,
    ),
    Sweep("depth, world units", (0.21, 0.3, 1, 10, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7), make_depths, lambda _: 1e-4),
]


def _worst_numbers(result: Result) -> dict[str, float]:
    return {"image": result.worst("planes", "stiff"), "gradients": result.worst("gradients", "stiff")}


def measure(sweep: Sweep) -> list[dict]:
    """Return for each value of a sweep the errors and milliseconds of every backend."""
    points = []
    for value in tqdm(sweep.values, desc=sweep.name, leave=False):
        judged = Judged(Case("sweep", f"{sweep.name} {value}", sweep.make(value), PLAIN, cut=sweep.cut(value)))
        point: dict = {"value": value, ROUNDING: _worst_numbers(judged.one_rounding())}
        for backend in BACKENDS:
            point[backend.name] = _worst_numbers(judged.result(backend)) | {
                "milliseconds": judged.milliseconds(backend)
            }
        points.append(point)
    return points


def draw(path: Path, measured: dict[str, list[dict]], title: str) -> None:
    """Draw a column for each sweep, and a row each for the errors of image and gradients and for milliseconds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 11), layout="constrained")
    panels = figure.subplots(len(ROWS), len(measured), sharex="col", sharey="row", squeeze=False)
    for column, (name, points) in enumerate(measured.items()):
        for row, (key, label) in enumerate(ROWS.items()):
            panel = panels[row][column]
            for backend, style in STYLES.items():
                line = [(p["value"], p[backend][key]) for p in points if key in p[backend]]
                if line:
                    # Zero has no place on a logarithmic axis, and the infinite none on any.
                    heights = [min(max(y, 1e-16), 10.0) if key != "milliseconds" else y for _, y in line]
                    panel.plot([x for x, _ in line], heights, label=backend, markersize=4, **style)
            panel.set(xscale="log", yscale="log")
            panel.grid(alpha=0.3)
            if column == 0:
                panel.set_ylabel(label)
        panels[-1][column].set_xlabel(name)
    panels[0][0].legend(fontsize="small")
    figure.suptitle(f"Error against condition, for stiff Gaussians\n{title}", fontsize=10)
    save_figure(figure, path, 100)


def main() -> None:
    """Measure the sweeps, and draw their figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", type=Path, help="image file to write")
    args = parser.parse_args()
    machine = describe_machine()
    print(machine)
    measured = {sweep.name: measure(sweep) for sweep in SWEEPS}
    draw(args.figure, measured, machine)


if __name__ == "__main__":
    run_cli(main)
