"""Figures of error against time: error_vs_time.png of a training, those of a report, and Pareto fronts.

`python -m splatting.evaluation.figures CSV PNG TITLE` draws a training's curve for curve_recorder.py. It imports
matplotlib, waits for a line on its standard input, draws, and prints what went wrong; without a line it draws nothing.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatting.evaluation.comparison import COSTS, pareto_front
from splatting.evaluation.error_curve import SUBSET, Row, best_test, read_curve, whole_sets
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HOLLOW = {"fillstyle": "none", "linewidth": 0.7, "marker": "o", "markersize": 4}  # points of subsets
COLORS = {"test": "#0072B2", "train": "#D55E00"}  # told apart by the colour-blind (Okabe and Ito)
STYLES = ("-", "-.", ":")
MARKERS = "osD"  # with ten colours they tell thirty sets apart
PEER_MARKERS = "xs^vDP*"
LABELS = {
    "seconds": "seconds of training, without scoring and saving",
    "gaussians": "Gaussians, as trained",
    "ply_mb": "megabytes of the PLY",
}

Value = Callable[[Row, str], float | None]
Point = tuple[float, float]


def psnr(row: Row, views: str) -> float | None:
    return row[f"{views}_psnr"]


def dissimilarity(row: Row, views: str) -> float | None:
    """1 - SSIM; None for equal images, which have no place on a logarithmic axis."""
    ssim = row[f"{views}_ssim"]
    return None if ssim is None or ssim >= 1 else 1 - ssim


def _gap(row: Row, views: str) -> float | None:
    both = row["train_psnr"], row["test_psnr"]
    return None if None in both else both[0] - both[1]


def printable(text: str) -> str:
    """Return the text with the bytes of a file name that are not UTF-8 written as numbers, `\\udcff`."""
    return text.encode("utf-8", "backslashreplace").decode()


def _points(rows: Sequence[Row], value: Value, views: str) -> list[Point]:
    """Seconds and values of the rows that have them; the axis of the seconds is logarithmic."""
    pairs = ((row["seconds"], value(row, views)) for row in rows)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def _draw(axes: Axes, points: Sequence[Point], label: str | None, **style: Any) -> None:
    axes.plot([x for x, _ in points], [y for _, y in points], label=label and printable(label), **style)


def _draw_rows(
    axes: Axes, rows: Sequence[Row], value: Value, views: str, labels: Sequence[str | None], **style: Any
) -> list[Point]:
    """Draw a line of the points that score whole sets, and a thin one with hollow points of subsets.

    labels: of both lines. Returns the points of whole sets.
    """
    whole = _points(whole_sets(rows), value, views)
    _draw(axes, whole, labels[0], **style)
    if part := _points([row for row in rows if row.get(SUBSET) is not None], value, views):
        _draw(axes, part, labels[1], **style | HOLLOW)
    return whole


def _label(axes: Axes, x: str, y: str, log: bool = False) -> None:
    """Label axes, of which that of x is logarithmic, and that of y if `log`, where there is something to show.

    Logarithmic ones are labelled at 1, 2, 5, 10, 20, ...: matplotlib's own labels 3 x 10^0 and 4 x 10^0 overlap.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(xlabel=x, ylabel=y)
    scales = {"xscale": axes.xaxis} | ({"yscale": axes.yaxis} if log else {})
    shown = any(len(line.get_xdata()) for line in axes.lines)
    for scale, axis in scales.items() if shown else ():
        axes.set(**{scale: "log"})
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="both", alpha=0.3, linewidth=0.5)


def _panels(rows: int, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, Sequence[Axes]]:
    from matplotlib.figure import Figure  # imported here: it takes long, and most programs draw nothing

    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(printable(title))
    return figure, figure.subplots(rows, columns, sharex=rows > 1)


def _save(figure: Figure, path: str | os.PathLike) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120, metadata={"Software": None})


def draw_curve(path: str | os.PathLike, rows: list[Row], title: str) -> None:
    """Draw PSNR and 1 - SSIM of test and train views against seconds of training, the gap between both shaded.

    Raises matplotlib's errors, ImportError if it is missing, and UserError if `path` cannot be written.
    """
    figure, (upper, lower) = _panels(2, 1, (7.5, 7.0), title)
    part = min((row[SUBSET] for row in rows if row[SUBSET] is not None), default=None)
    for axes, value, unit in ((upper, psnr, " dB"), (lower, dissimilarity, "")):
        for views, color in COLORS.items():
            labels = (f"{views} views", f"{views} views, {part} of them")
            _draw_rows(axes, rows, value, views, labels, marker="o", markersize=3, color=color)
        for kind in (True, False):  # of whole sets, of subsets
            both = [row for row in rows if (row[SUBSET] is None) == kind and row["seconds"] > 0]
            both = [row for row in both if None not in (value(row, "test"), value(row, "train"))]
            ends = [[value(row, views) for row in both] for views in COLORS]
            label = f"gap, {abs(ends[1][-1] - ends[0][-1]):.3g}{unit} at the end" if kind and both else None
            axes.fill_between(
                [row["seconds"] for row in both], *ends, color="gray", alpha=0.2, linewidth=0, label=label
            )
    if best := best_test(rows):
        label = f"best test: {best['test_psnr']:.2f} dB, iteration {best['iteration']}"
        _draw(upper, [(best["seconds"], best["test_psnr"])], label, marker="*", color="black", markersize=12)
    _label(upper, "", "PSNR, dB")
    _label(lower, LABELS["seconds"], "1 - SSIM", log=True)
    for axes in (upper, lower):
        axes.legend()
    _save(figure, path)


def draw_curves(path: Path, scene: str, runs: Sequence[dict[str, Any]], peers: Sequence[dict[str, Any]] = ()) -> bool:
    """Draw test PSNR and 1 - SSIM of a scene's runs against seconds of training; return False if no run has a curve.

    Each option set has a colour and each seed a line. With several option sets, the Pareto front of all points is
    marked, without runs that stand apart, and a third panel has the gap between training and test views. With one, the
    training views are drawn too, dashed. Points of subsets are in no front, and not in the third panel, as the gap
    between two subsets is mostly chance. peers: curves of other programs, in grey; they are no part of the front.
    """
    runs = [run for run in runs if any(row["test_psnr"] is not None for row in run["curve"])]
    if not runs:
        return False
    several = len({run["config"] for run in runs}) > 1
    panels = [(psnr, "PSNR of the test views (dB)", -1), (dissimilarity, "1 - SSIM of the test views", 1)]
    if several and any(_points(whole_sets(run["curve"]), _gap, "") for run in runs):
        panels.append((_gap, "PSNR of the training views above the test views (dB)", 0))
    figure, every = _panels(1, len(panels), (6 * len(panels), 4.8), f"{scene}: error against time")
    for axes, (value, label, sign) in zip(every, panels, strict=True):
        ours = _draw_runs(axes, runs, value, several)
        if several and sign and ours:
            draw_front(axes, ours, sign)
        theirs = _draw_peers(axes, peers, value)
        _label(axes, LABELS["seconds"] + theirs, label, log=value is dissimilarity)
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
        name = run["config"] or ("no option set" if several else "test")
        name += " (other ground truth)" if run["apart"] else ""
        style = {"color": f"C{index % 10}", "linestyle": STYLES[index // 10 % len(STYLES)], "linewidth": 1.2}
        style |= {"marker": ".", "alpha": 0.4 if run["apart"] else 1.0}
        labels = name if first else None, "a subset of the test views" if run is runs[0] else None
        rows = whole_sets(run["curve"]) if value is _gap else run["curve"]
        found = _draw_rows(axes, rows, value, "test", labels, **style)
        every += [] if run["apart"] else found
        if not several:
            dashed = style | {"marker": "", "linestyle": "--", "alpha": 0.6}
            _draw_rows(axes, rows, value, "train", ("train" if first else None, None), **dashed)
    return every


def _draw_peers(axes: Axes, peers: Sequence[dict[str, Any]], value: Value) -> str:
    """Draw other programs' curves; return what is to be said of the axis if there are any."""
    found = [(peer["name"], points) for peer in peers if (points := _points(peer["curve"], value, "test"))]
    for index, (name, points) in enumerate(found):
        _draw(
            axes, points, f"{name} (another program)", color="0.35", linestyle="--",
            marker=PEER_MARKERS[index % len(PEER_MARKERS)], markersize=5, linewidth=1.2,
        )  # fmt: skip
    return " (other programs: as they count)" if found else ""


def draw_front(axes: Axes, points: Sequence[Point], sign: int) -> None:
    """Mark the Pareto front. sign: 1 if a lower number is better, -1 if a higher one is.

    Between each two points lies a corner, unmarked: matplotlib places its legend clear of these, but not of lines that
    it draws with drawstyle "steps".
    """
    front = [points[i] for i in pareto_front([(seconds, sign * number) for seconds, number in points])]
    corners = [(after[0], before[1]) for before, after in zip(front, front[1:], strict=False)]
    stairs = [point for pair in zip(front, corners, strict=False) for point in pair] + front[-1:]
    _draw(
        axes, stairs, "Pareto front", color="black", linewidth=0.6, marker="o", markevery=2, markerfacecolor="none",
        markersize=8,
    )  # fmt: skip


def draw_fronts(path: Path, scene: str, found: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Draw PSNR against each cost, where each option set ended.

    found: the scene's `fronts` in report.json. names: all option sets of the scene, which colours follow, so that they
    are those of the curves. A point is the mean over the seeds, a bar the standard deviation; the front goes
    through the means.
    """
    size = (6 * len(COSTS), 4.8)
    figure, every = _panels(1, len(COSTS), size, f"{scene}: where each option set ended")
    for axes, cost in zip(every, COSTS, strict=True):
        for name, point in found["sets"].items():
            index, x, y = names.index(name), point[cost], point["PSNR"]
            axes.errorbar(
                x["mean"], y["mean"], xerr=x["std"], yerr=y["std"], label=printable(name), color=f"C{index % 10}",
                marker=MARKERS[index // 10 % len(MARKERS)], markersize=5, linewidth=1, capsize=2,
            )  # fmt: skip
        draw_front(axes, [(point[cost]["mean"], point["PSNR"]["mean"]) for point in found["sets"].values()], -1)
        _label(axes, LABELS[cost], "PSNR of the test views (dB)")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    _save(figure, path)
    return True


def main() -> None:
    """Draw for `CurveRecorder`."""
    gc.disable()  # for the second that this takes
    with contextlib.suppress(Exception):  # drawing reports it
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401
    if sys.stdin.readline():
        source, target, title = sys.argv[1:]
        try:
            draw_curve(target, read_curve(source), title)
        except Exception as error:  # a broken matplotlib may raise anything, and the model is trained
            print(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
