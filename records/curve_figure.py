"""error_vs_time.png: the curve of a training as a figure."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from records.error_curve import SUBSET, Row, best_test, whole_sets
from records.plain_log_axis import plain_log_axis
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HOLLOW = {"fillstyle": "none", "linewidth": 0.7}  # points of subsets
COLORS = {"test": "#0072B2", "train": "#D55E00"}  # told apart by the colour-blind (Okabe and Ito)


def draw_curve(path: str | os.PathLike, rows: list[Row], title: str) -> None:
    """Draw PSNR and 1 - SSIM of test and train views against seconds of training, the gap between both shaded.

    Points that score a subset of the views are hollow, and have a thin line of their own.
    Raises matplotlib's errors, ImportError if it is missing, and UserError if `path` cannot be written.
    """
    from matplotlib.figure import Figure  # imported here: it takes long, and no training depends on it

    rows = [row for row in rows if row["seconds"] > 0]  # the axis is logarithmic
    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    _compare(upper, rows, lambda row, views: row[f"{views}_psnr"], " dB")
    _compare(lower, rows, _dissimilarity, "")
    _mark_best(upper, rows)
    upper.set(title=title, ylabel="PSNR, dB", xscale="log")
    plain_log_axis(lower.xaxis)
    lower.set(ylabel="1 - SSIM", xlabel="seconds of training, without evaluation and saving")
    if lower.lines:
        lower.set_yscale("log")
        plain_log_axis(lower.yaxis)
    for axes in (upper, lower):
        axes.grid(alpha=0.3, which="both", linewidth=0.5)
        if axes.lines:
            axes.legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _dissimilarity(row: Row, views: str) -> float | None:
    ssim = row[f"{views}_ssim"]
    return None if ssim is None or ssim >= 1 else 1 - ssim  # equal images have no place on a logarithmic axis


def _compare(axes: Axes, rows: list[Row], value: Callable[[Row, str], float | None], unit: str) -> None:
    """Draw lines of test and train views, of whole sets and of subsets, and shade the gap between test and train."""
    parts = [row for row in rows if row[SUBSET] is not None]
    for views, color in COLORS.items():
        for kind, style in ((parts, HOLLOW), (whole_sets(rows), {})):
            points = [(row["seconds"], value(row, views)) for row in kind if value(row, views) is not None]
            if points:
                sizes = sorted({row[SUBSET] for row in kind})[:1] if kind is parts else []
                label = f"{views} views" + "".join(f", {size} of them" for size in sizes)
                style = {"color": color, "marker": "o", "markersize": 3, "label": label} | style
                axes.plot(*zip(*points, strict=True), **style)
    for kind in (parts, whole_sets(rows)):
        both = [(row["seconds"], value(row, "test"), value(row, "train")) for row in kind]
        both = [point for point in both if None not in point]
        if both:
            label = None if kind is parts else f"gap, {abs(both[-1][2] - both[-1][1]):.3g}{unit} at the end"
            axes.fill_between(*zip(*both, strict=True), color="gray", alpha=0.2, linewidth=0, label=label)


def _mark_best(axes: Axes, rows: list[Row]) -> None:
    if best := best_test(rows):
        label = f"best test: {best['test_psnr']:.2f} dB, iteration {best['iteration']}"
        axes.plot(best["seconds"], best["test_psnr"], "*", color="black", markersize=12, label=label)
