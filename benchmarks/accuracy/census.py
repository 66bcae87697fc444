"""A census of stiffness: how stretched, long, thin, opaque and near the Gaussians of trained models are.

    python -m benchmarks.accuracy.census bonsai=OUT/bonsai lego=OUT/lego/point_cloud/iteration_7000/point_cloud.ply
    python -m benchmarks.accuracy.census OUT/fox --figure docs/census.png     # needs matplotlib

A model is a folder of train.py, or a PLY. A PLY that lies in no such folder gets eight cameras around its middle.
Counted are Gaussians (axis ratio, largest length over all views, opacity) or splats, which are Gaussians in a view
(condition of the 2D covariance, distance in front of the camera in world units). A length is the standard deviation in
px along the long axis of the ellipse, with its dilation. Quantiles of splats are right within 2.4 %.

The second table puts the cases of benchmarks.accuracy.stability on these axes: the extreme of a case's stiff Gaussians,
and in percent how many Gaussians or splats of the model that has the most are more extreme. The third one lists what no
case covers: for two axes at a time, decades that hold splats of a model and none of any case.
"""

import math
from collections import Counter
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import Gaussians
from tqdm import tqdm

from benchmarks.accuracy.splat_shapes import Histogram, Sorted, Splats, count_cells, measure_splats, sort_axes
from benchmarks.accuracy.trained_models import TrainedModel, load_trained, model_parser
from benchmarks.harness.measuring import choose_device, describe_machine, print_table
from splatting.records.figures import save_figure
from tests.workloads.stability_cases import CASES, Case
from utils.system_utils import UserError, run_cli

SHARES = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0)
AXES = {
    "ratio": "axis ratio",
    "length": "length, px",
    "condition": "condition in 2D",
    "opacity": "opacity",
    "depth": "distance",
}
LEAST = 1e-4  # share of a model's splats; cells with fewer are not listed
CLASSES = ("below 1/255", "1/255 to 0.1", "0.1 to 0.99", "0.99 and more")  # of opacities, as in `count_cells`
MOST_CELLS = 8  # of a model
LARGEST = 1e9  # drawn of a case


class Census(NamedTuple):
    """The numbers of one model: their distribution by axis, and counts of splats by cell."""

    label: str
    axes: dict[str, Sorted | Histogram]
    cells: Counter[tuple[int, ...]]

    @property
    def splats(self) -> int:
        return sum(self.cells.values())


def census(model: TrainedModel) -> Census:
    """Count a model's Gaussians and splats, one view after the other. UserError if no view shows any."""
    device, counts = model.gaussians.means.device, Counter()
    longest = torch.zeros(model.count, dtype=torch.float64, device=device)
    condition, depth = Histogram(device), Histogram(device)
    for camera in tqdm(model.cameras, desc=model.label, unit="view", leave=False):
        for splats in measure_splats(model.gaussians, camera):
            condition.add(splats.condition)
            depth.add(splats.depth)
            counts += count_cells(splats)
            longest[splats.row] = torch.maximum(longest[splats.row], splats.length)
    if not counts:
        raise UserError(f"no view shows a Gaussian of {model.label}; is this the model of these cameras?")
    axes = sort_axes(model.gaussians._replace(scales=model.gaussians.scales.double().exp()))
    by_axis = {
        "ratio": Sorted((axes[:, 0] / axes[:, 2]).nan_to_num(1.0, posinf=math.inf)),
        "length": Sorted(longest[longest > 0]),
        "condition": condition,
        "opacity": Sorted(model.gaussians.opacities.double().sigmoid().reshape(-1)),
        "depth": depth,
    }
    return Census(model.label, by_axis, counts)


def measure_case(case: Case) -> tuple[Splats, Splats] | None:
    """All splats of a case, and the stiff ones; None where nothing finite is shown."""
    problem = case.problem()
    present, raw = ~problem.absent, problem.raw
    gaussians = Gaussians(**{name: values[present] for name, values in problem.parameters.items()})
    parts = list(measure_splats(gaussians, problem.camera, raw))
    if not parts or not len(parts[0].row):
        return None
    (shown,) = parts
    stiff = problem.stiff[present][shown.row]
    return shown, Splats(*(values[stiff] for values in shown))


def find_extremes(stiff: Splats) -> dict[str, float]:
    """The most extreme numbers of splats: the nearest distance, and the largest of the others."""
    return {axis: float(getattr(stiff, axis).min() if axis == "depth" else getattr(stiff, axis).max()) for axis in AXES}


def case_rows(censuses: list[Census], by_case: dict[Case, tuple[Splats, Splats]]) -> list[list[str]]:
    """A row for each case: its extremes, and the largest share of a model beyond each, percent."""
    rows = []
    for case, (_, stiff) in by_case.items():
        if not len(stiff.row):
            continue
        row = [case.name]
        for axis, value in find_extremes(stiff).items():
            beyond = max(found.axes[axis].beyond(value, below=axis == "depth") for found in censuses)
            row.append(f"{_format_short(value)} ({_format_percent(beyond)})")
        rows.append(row)
    return rows


def project_counts(counts: Counter, pair: tuple[int, int]) -> Counter:
    """Counts by the classes of two axes."""
    found = Counter()
    for cell, count in counts.items():
        found[cell[pair[0]], cell[pair[1]]] += count
    return found


def find_uncovered(found: Census, covered: Iterable[tuple[int, ...]]) -> list[tuple[float, str, str]]:
    """Share of a model's splats in each cell of two axes that no case covers, most first, with the cell in words."""
    covered, gaps, names = Counter(covered), [], list(AXES)
    for pair in combinations(range(len(AXES)), 2):
        known = project_counts(covered, pair)
        for cell, count in project_counts(found.cells, pair).items():
            if cell not in known:
                words = [
                    f"{AXES[names[axis]]} {_name_class(names[axis], of)}" for axis, of in zip(pair, cell, strict=True)
                ]
                gaps.append((count / found.splats, *words))
    return sorted(gaps, reverse=True)


def _name_class(axis: str, number: int) -> str:
    return CLASSES[number] if axis == "opacity" else f"1e{number} to 1e{number + 1}"


def _format_short(value: float) -> str:
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.0e}"


def _format_percent(share: float) -> str:
    return "0" if share <= 0 else f"{100 * share:.2g}" if share < 0.1 else f"{100 * share:.0f}"


def print_report(censuses: list[Census], by_case: dict[Case, tuple[Splats, Splats]]) -> None:
    """Print the three tables."""
    header = ["model", "axis", *(f"{100 * share:g} %" for share in SHARES[:-1]), "largest"]
    rows = [
        [found.label, AXES[axis], *(_format_short(found.axes[axis].quantile(share)) for share in SHARES)]
        for found in censuses
        for axis in AXES
    ]
    print_table(header, rows)
    print("\nCases: extremes of stiff Gaussians, and percent of a model beyond them\n")
    print_table(["case", *AXES.values()], case_rows(censuses, by_case))
    covered = [cell for shown, _ in by_case.values() for cell in count_cells(shown)]
    print("\nSplats where no case has any\n")
    rows = [
        [found.label, first, second, f"{100 * share:.2g} %"]
        for found in censuses
        for share, first, second in find_uncovered(found, covered)[:MOST_CELLS]
        if share >= LEAST
    ]
    print_table(["model", "one axis", "the other", "splats"], rows)


def draw(path: Path, censuses: list[Census], by_case: dict[Case, tuple[Splats, Splats]]) -> None:
    """Draw the share of each model above a number, by axis, and a mark for the extreme of each case."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 7.5), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    stiffest = [find_extremes(stiff) for _, stiff in by_case.values() if len(stiff.row)]
    for panel, (axis, name) in zip(panels, AXES.items(), strict=False):
        for found in censuses:
            panel.plot(*found.axes[axis].curve(), label=found.label, linewidth=1.5)
        marks = [case[axis] for case in stiffest if case[axis] < LARGEST]
        panel.plot(marks, [2e-8] * len(marks), "|k", markersize=12, alpha=0.6, label="stability cases")
        panel.set(xlabel=name, yscale="log", ylim=(1e-8, 1.5), xscale="linear" if axis == "opacity" else "log")
        panel.grid(alpha=0.3)
    for row in (0, 3):
        panels[row].set_ylabel("share above")
    panels[5].axis("off")
    handles, labels = panels[0].get_legend_handles_labels()
    panels[5].legend(handles, labels, fontsize="small", loc="upper left")
    save_figure(figure, path, 80)


@torch.no_grad()
def main() -> None:
    """Print the census of the models that the command line names, beside the stiff cases, and draw it if asked."""
    args = model_parser(__doc__).parse_args()
    device = choose_device(args)
    censuses = []
    for word in args.models:
        model = load_trained(word, device)
        censuses.append(census(model))
        print(f"{model.label}: {model.count} Gaussians, {len(model.cameras)} {'made ' if model.made else ''}views")
    print(describe_machine(device) + "\n")
    by_case = {case: splats for case in CASES if (splats := measure_case(case))}
    print_report(censuses, by_case)
    if args.figure:
        draw(args.figure, censuses, by_case)


if __name__ == "__main__":
    run_cli(main)
