"""Figures of the report: error against time of a scene, and its Pareto fronts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatting.evaluation.contact_sheet import printable
from splatting.evaluation.curve_figure import HOLLOW, Value, dissimilarity, plain_log_axis, points, psnr
from splatting.evaluation.error_curve import SUBSET, Row, whole_sets
from splatting.evaluation.option_sets import COSTS, pareto_front
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Point = tuple[float, float]
STYLES = ("-", "-.", ":")
MARKERS = "osD"  # with ten colours they tell thirty sets apart
PEER_MARKERS = "xs^vDP*"
LABELS = {
    "seconds": "seconds of training, without scoring and saving",
    "gaussians": "Gaussians, as trained",
    "ply_mb": "megabytes of the PLY",
}


def _gap(row: Row, views: str) -> float | None:
    both = row["train_psnr"], row["test_psnr"]
    return None if None in both else both[0] - both[1]


def _panels(count: int, title: str) -> tuple[Figure, Sequence[Axes]]:
    from matplotlib.figure import Figure  # imported here because only a report needs it

    figure = Figure(figsize=(6 * count, 4.8), layout="constrained")
    figure.suptitle(printable(title))
    return figure, figure.subplots(1, count)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set(xscale="log", xlabel=x, ylabel=y)
    plain_log_axis(axes.xaxis)
    axes.grid(True, which="both", alpha=0.3)


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})


def draw_curves(path: Path, scene: str, runs: Sequence[dict[str, Any]], peers: Sequence[dict[str, Any]] = ()) -> bool:
    """Draw test PSNR and 1 - SSIM of a scene's runs against seconds of training; return False if no run has a curve.

    Each option set has a colour and each seed a line. With several option sets, the Pareto front of all points is
    marked, without runs that stand apart, and a third panel has the gap between training and test views. With one, the
    training views are drawn too, dashed. Points that score a subset of the views are hollow, on a thin line of their
    own, and in no front. They are not in the third panel, as the gap between two subsets is mostly chance.
    peers: curves of other programs, in grey; they are no part of the front.
    """
    runs = [run for run in runs if any(row["test_psnr"] is not None for row in run["curve"])]
    if not runs:
        return False
    several = len({run["config"] for run in runs}) > 1
    panels = [(psnr, "PSNR of the test views (dB)", -1), (dissimilarity, "1 - SSIM of the test views", 1)]
    if several and any(points(whole_sets(run["curve"]), _gap, "") for run in runs):
        panels.append((_gap, "PSNR of the training views above the test views (dB)", 0))
    figure, every = _panels(len(panels), f"{scene}: error against time")
    for axes, (value, label, sign) in zip(every, panels, strict=True):
        ours = _draw_runs(axes, runs, value, several)
        if several and sign and ours:
            draw_front(axes, ours, sign)
        theirs = _draw_peers(axes, peers, value)
        _label(axes, LABELS["seconds"] + (" (other programs: as they count)" if theirs else ""), label)
        if value is dissimilarity and ours + theirs:
            axes.set_yscale("log")
            plain_log_axis(axes.yaxis)
        axes.legend(fontsize="small")
    _save(figure, path)
    return True


def _draw_runs(axes: Axes, runs: Sequence[dict[str, Any]], value: Value, several: bool) -> list[Point]:
    """Draw a line for each run; return the points of those that do not stand apart."""
    configs = list(dict.fromkeys(run["config"] for run in runs))
    every: list[Point] = []
    for run in runs:
        index = configs.index(run["config"])
        first = run is next(other for other in runs if other["config"] == run["config"])
        whole, part = whole_sets(run["curve"]), [row for row in run["curve"] if row.get(SUBSET) is not None]
        ours = points(whole, value, "test")
        name = run["config"] or ("no option set" if several else "test")
        style = {"color": f"C{index % 10}", "linestyle": STYLES[index // 10 % len(STYLES)], "linewidth": 1.2}
        if run["apart"]:
            name, style["alpha"] = f"{name} (other ground truth)", 0.4
        else:
            every += ours
        axes.plot(*_columns(ours), marker=".", label=name if first else None, **style)
        hollow = style | HOLLOW | {"marker": "o"}
        if value is not _gap and (few := points(part, value, "test")):
            axes.plot(*_columns(few), label="a subset of the test views" if run is runs[0] else None, **hollow)
        if not several and (train := points(whole, value, "train")):
            axes.plot(*_columns(train), label="train" if first else None, **style | {"linestyle": "--", "alpha": 0.6})
            axes.plot(*_columns(points(part, value, "train")), **hollow | {"linestyle": "--", "alpha": 0.6})
    return every


def _draw_peers(axes: Axes, peers: Sequence[dict[str, Any]], value: Value) -> list[Point]:
    every: list[Point] = []
    for index, peer in enumerate(peers):
        if theirs := points(peer["curve"], value, "test"):
            axes.plot(
                *_columns(theirs), color="0.35", linestyle="--", marker=PEER_MARKERS[index % len(PEER_MARKERS)],
                markersize=5, linewidth=1.2, label=f"{printable(peer['name'])} (another program)",
            )  # fmt: skip
        every += theirs
    return every


def draw_front(axes: Axes, points: Sequence[Point], sign: int) -> None:
    """Mark the Pareto front. sign: 1 if a lower number is better, -1 if a higher one is.

    Between each two points lies a corner, unmarked: matplotlib places its legend clear of these, but not of lines that
    it draws with drawstyle "steps".
    """
    front = [points[i] for i in pareto_front([(seconds, sign * number) for seconds, number in points])]
    corners = [(after[0], before[1]) for before, after in zip(front, front[1:], strict=False)]
    stairs = [point for pair in zip(front, corners, strict=False) for point in pair] + front[-1:]
    axes.plot(
        *_columns(stairs), color="black", linewidth=0.6, marker="o", markevery=2, markerfacecolor="none", markersize=8,
        label="Pareto front",
    )  # fmt: skip


def _columns(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def draw_fronts(path: Path, scene: str, found: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Draw PSNR against each cost, where each option set ended.

    found: the scene's `fronts` in report.json. names: all option sets of the scene, which colours follow, so that they
    are those of the curves. A point is the mean over the seeds, a bar the standard deviation; the front goes
    through the means.
    """
    figure, every = _panels(len(COSTS), f"{scene}: where each option set ended")
    for axes, cost in zip(every, COSTS, strict=True):
        ends = []
        for name, point in found["sets"].items():
            index, x, y = names.index(name), point[cost], point["PSNR"]
            ends.append((x["mean"], y["mean"]))
            axes.errorbar(
                *ends[-1], xerr=x["std"], yerr=y["std"], label=printable(name), color=f"C{index % 10}",
                marker=MARKERS[index // 10 % len(MARKERS)], markersize=5, linewidth=1, capsize=2,
            )  # fmt: skip
        draw_front(axes, ends, -1)
        _label(axes, LABELS[cost], "PSNR of the test views (dB)")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    _save(figure, path)
    return True
