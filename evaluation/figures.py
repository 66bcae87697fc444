"""Figures of the report: error against time of a scene, and its worst test views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evaluation.contact_sheet import contact_sheet
from evaluation.model_folder import counted_picture
from evaluation.printable import printable
from evaluation.tradeoff import pareto_front
from records.error_curve import SUBSET, Row, whole_sets
from records.plain_log_axis import plain_log_axis
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HOLLOW = {"fillstyle": "none", "linewidth": 0.6, "markersize": 4}  # points of subsets
WIDEST = 480  # largest width, in pixels, of an image on a sheet


Point = tuple[float, float]
Value = Callable[[Row, str], float | None]
STYLES = ("-", "-.", ":")
PEER_MARKERS = "xs^vDP*"


def _psnr(row: Row, views: str) -> float | None:
    return row[f"{views}_psnr"]


def _dissimilarity(row: Row, views: str) -> float | None:
    ssim = row[f"{views}_ssim"]
    return None if ssim is None else 1 - ssim


def _gap(row: Row, views: str) -> float | None:
    both = row["train_psnr"], row["test_psnr"]
    return None if None in both else both[0] - both[1]


def draw_curves(path: Path, scene: str, runs: Sequence[dict[str, Any]], peers: Sequence[dict[str, Any]] = ()) -> bool:
    """Draw test PSNR and 1 - SSIM of a scene's runs against seconds of training; return False if no run has a curve.

    Each option set has a colour and each seed a line. With several option sets, the Pareto front of all points is
    marked, without runs that stand apart, and a third panel has the gap between training and test views. With one, the
    training views are drawn too, dashed. Points that score a subset of the views are hollow, on a thin line of their
    own, and in no front. They are not in the third panel, as the gap between two subsets is mostly chance.
    peers: curves of other programs, in grey; they are no part of the front.
    """
    from matplotlib.figure import Figure  # imported here because only a report needs it

    runs = [run for run in runs if any(row["test_psnr"] is not None for row in run["curve"])]
    if not runs:
        return False
    several = len({run["config"] for run in runs}) > 1
    panels = [(_psnr, "PSNR of the test views (dB)", -1), (_dissimilarity, "1 - SSIM of the test views", 1)]
    if several and any(_points(whole_sets(run["curve"]), _gap, "") for run in runs):
        panels.append((_gap, "PSNR of the training views above the test views (dB)", 0))
    figure = Figure(figsize=(6 * len(panels), 4.8), layout="constrained")
    figure.suptitle(f"{printable(scene)}: error against time")
    for axes, (value, label, sign) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        every = _draw_runs(axes, runs, value, several)
        if several and sign and every:
            draw_front(axes, every, sign)
        theirs = _draw_peers(axes, peers, value)
        drawn = every + theirs
        seconds = "seconds of training, without scoring and saving" + (
            " (other programs: as they count)" if theirs else ""
        )
        axes.set(xscale="log", xlabel=seconds, ylabel=label)
        plain_log_axis(axes.xaxis)
        if value is _dissimilarity and drawn and all(number > 0 for _, number in drawn):
            axes.set_yscale("log")
            plain_log_axis(axes.yaxis)
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize="small")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})
    return True


def _draw_runs(axes: Axes, runs: Sequence[dict[str, Any]], value: Value, several: bool) -> list[Point]:
    """Draw a line for each run; return the points of those that do not stand apart."""
    configs = list(dict.fromkeys(run["config"] for run in runs))
    every: list[Point] = []
    for run in runs:
        index = configs.index(run["config"])
        first = run is next(other for other in runs if other["config"] == run["config"])
        whole, part = whole_sets(run["curve"]), [row for row in run["curve"] if row.get(SUBSET) is not None]
        points = _points(whole, value, "test")
        name = run["config"] or ("no option set" if several else "test")
        style = {"color": f"C{index % 10}", "linestyle": STYLES[index // 10 % len(STYLES)], "linewidth": 1.2}
        if run["apart"]:
            name, style["alpha"] = f"{name} (other ground truth)", 0.4
        else:
            every += points
        axes.plot(*_columns(points), marker=".", label=name if first else None, **style)
        if value is not _gap and (few := _points(part, value, "test")):
            label = "a subset of the test views" if run is runs[0] else None
            axes.plot(*_columns(few), marker="o", label=label, **style | HOLLOW)
        if not several and (train := _points(whole, value, "train")):
            style |= {"linestyle": "--", "alpha": 0.6}
            axes.plot(*_columns(train), label="train" if first else None, **style)
            axes.plot(*_columns(_points(part, value, "train")), marker="o", **style | HOLLOW)
    return every


def draw_front(axes: Axes, points: Sequence[Point], sign: int) -> None:
    """Mark the Pareto front. sign: 1 if a lower number is better, -1 if a higher one is."""
    front = [points[i] for i in pareto_front([(seconds, sign * number) for seconds, number in points])]
    axes.plot(
        *_columns(_stairs(front)), color="black", linewidth=0.6, marker="o", markevery=2, markerfacecolor="none",
        markersize=8, label="Pareto front",
    )  # fmt: skip


def _draw_peers(axes: Axes, peers: Sequence[dict[str, Any]], value: Value) -> list[Point]:
    every: list[Point] = []
    for index, peer in enumerate(peers):
        points = _points(peer["curve"], value, "test")
        marker = PEER_MARKERS[index % len(PEER_MARKERS)]
        if points:
            axes.plot(*_columns(points), color="0.35", linestyle="--", marker=marker, markersize=5, linewidth=1.2,
                      label=f"{printable(peer['name'])} (another program)")  # fmt: skip
        every += points
    return every


def _points(curve: Sequence[Row], value: Value, views: str) -> list[Point]:
    pairs = ((row["seconds"], value(row, views)) for row in curve)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def _columns(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _stairs(points: Sequence[Point]) -> list[Point]:
    """Return the points with a corner between each two, so that every second one is a point.

    Matplotlib places its legend clear of these, but not of lines that it draws with drawstyle "steps".
    """
    corners = [(after[0], before[1]) for before, after in zip(points, points[1:], strict=False)]
    return [point for pair in zip(points, corners, strict=False) for point in pair] + list(points[-1:])


def draw_worst_views(path: Path, run: dict[str, Any], output: Path) -> bool:
    """Draw a run's worst test views with ground truth, render and amplified error; return False if it has none.

    Pixels that do not count are white in the images and black in the error.
    """
    folder = output / run["model"] / "test" / f"ours_{run['final_iteration']}"
    if not run["worst_views"]:
        return False
    rows = [
        (
            f"{view['picture']}: {view['PSNR']:.2f} dB",
            *(counted_picture(folder, side, view["file"]) for side in ("gt", "renders")),
        )
        for view in run["worst_views"]
    ]
    with atomic_write(path) as temporary:
        contact_sheet(rows, WIDEST).save(temporary)
    return True
