"""Figure of error against time: error_vs_time.png of a training.

`python -m splatting.records.figures CSV PNG TITLE TEST_VIEWS TRAIN_VIEWS` draws a training's curve for
curve_recorder.py. It imports matplotlib, waits for a line on its standard input, draws, and prints what went wrong;
without a line it draws nothing.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from groundwork.host.listing import as_utf8
from splatting.records.error_curve import SUBSET, Row, best_test, common_subset, read_curve, rows_on, whole_sets
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {"test": "#0072B2", "train": "#D55E00"}  # told apart by the colour-blind (Okabe and Ito)
HOLLOW = {"linestyle": ":", "linewidth": 1, "markerfacecolor": "white", "zorder": 3}  # whole sets beside a subset

Value = Callable[[Row, str], float | None]
Point = tuple[float, float]


def psnr(row: Row, views: str) -> float | None:
    """Return the PSNR of a set of views, dB."""
    return row[f"{views}_psnr"]


def dissimilarity(row: Row, views: str) -> float | None:
    """Return 1 - SSIM; None for equal images, which have no place on a logarithmic axis."""
    ssim = row[f"{views}_ssim"]
    return None if ssim is None or ssim >= 1 else 1 - ssim


def line_of(rows: Sequence[Row], value: Value, views: str) -> list[Point]:
    """Return seconds and values of the rows that have both; seconds must be above 0 on a logarithmic axis."""
    pairs = ((row["seconds"], value(row, views)) for row in rows)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def draw_line(axes: Axes, points: Sequence[Point], label: str | None, **style: Any) -> None:
    """Draw a line through points. style: options of matplotlib."""
    axes.plot([x for x, _ in points], [y for _, y in points], label=label and as_utf8(label), **style)


def describe_views(subset: int | None, count: int | None, kind: str = "test") -> str:
    """Return a text that says which views of a set are scored. Of the train views, only a few ever are.

    subset: number of views that are scored, None: all.
    count: number of views in the set; None where it differs.
    kind: "test" or "train".
    """
    if kind == "train":
        return f"{count if subset is None else subset:,} train views"
    if subset is None:
        return " ".join(["all", *([] if count is None else [f"{count:,}"]), "test views"])
    return f"{subset:,} of {'the' if count is None else f'{count:,}'} test views"


def label_axes(axes: Axes, x: str, y: str, log: bool = False) -> None:
    """Label the axes, and make x logarithmic, and y if `log`, where there is something to show.

    Logarithmic axes are labelled at 1, 2, 5, 10, 20, ..., and y, which spans less, at 3, too: matplotlib's own labels 3
    x 10^0 and 4 x 10^0 overlap.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(xlabel=x, ylabel=y)
    scales = {"xscale": axes.xaxis} | ({"yscale": axes.yaxis} if log else {})
    shown = any(len(line.get_xdata()) for line in axes.lines)
    for scale, axis in scales.items() if shown else ():
        axes.set(**{scale: "log"})
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if axis is axes.xaxis else (1, 2, 3, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="both", alpha=0.3, linewidth=0.5)


@cache
def forget_settings() -> None:
    """Forget the settings of a matplotlibrc in the folder that a user works in, which may call for TeX."""
    from matplotlib import rcdefaults

    rcdefaults()


def make_figure(rows: int, size: tuple[float, float], title: str) -> tuple[Figure, Any]:
    """Make a figure of so many panels, one below the other. size: inches."""
    from matplotlib.figure import Figure  # imported here: it takes long, and most programs draw nothing

    forget_settings()
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(as_utf8(title))
    return figure, figure.subplots(rows, 1, sharex=True)


def save_figure(figure: Figure, path: str | os.PathLike, dpi: int = 120) -> None:
    """Write a figure, whole or not at all. Its bytes do not tell the version of matplotlib."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=dpi, metadata={"Software": None})


def draw_curve(path: str | os.PathLike, rows: list[Row], title: str, views: Mapping[str, int]) -> None:
    """Draw PSNR and 1 - SSIM of test and train views against seconds of training, the gap between both shaded.

    Each subset of the views has a line of its own; whole sets beside it have a dotted and hollow line. Raises
    matplotlib's errors, ImportError if it is missing, and UserError if `path` cannot be written.

    views: number of views of each set.
    """
    figure, (upper, lower) = make_figure(2, (7.5, 7.0), title)
    subsets = {int(row[SUBSET]) for row in rows if row[SUBSET] is not None}
    main = common_subset([rows])
    for axes, value, unit in ((upper, psnr, " dB"), (lower, dissimilarity, "")):
        for subset in (*sorted(subsets), None):
            for name, color in COLORS.items():
                style = HOLLOW if subset is None and subsets else {"linewidth": 1.2}
                points = line_of(rows_on(rows, subset), value, name)
                label = describe_views(subset, views[name], name) if points or subset is None else None
                draw_line(axes, points, label, **{"marker": "o", "markersize": 4, "color": color} | style)
        scored = [row for row in rows if row["seconds"] > 0 and None not in [value(row, name) for name in COLORS]]
        both = rows_on(scored, main)
        _shade_gap(axes, both, scored[-1:] or both, value, unit, views["test"])
    if len(whole_sets(rows)) > 1 and (best := best_test(rows)):
        label = f"highest mean over all test views: {best['test_psnr']:.2f} dB, iteration {best['iteration']:,}"
        draw_line(
            upper, [(best["seconds"], best["test_psnr"])], label, marker="*", color="black", markersize=12, linestyle=""
        )
    label_axes(upper, "", "PSNR (dB)")
    label_axes(lower, "seconds of training, without scoring and saving", "1 - SSIM", log=True)
    for axes, below in ((upper, -0.05), (lower, -0.2)):  # the label of the lower axis is between
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncols=2, frameon=False)
    save_figure(figure, path)


def _shade_gap(axes: Axes, rows: Sequence[Row], end: Sequence[Row], value: Value, unit: str, views: int) -> None:
    """Shade the gap between test and train views at rows that have both, and state the gap of the last row, `end`."""
    lines, label = [[value(row, name) for row in rows] for name in COLORS], None
    if len(rows) > 1:
        test, train = (value(end[0], name) for name in COLORS)
        which = "" if end[0][SUBSET] is None else f", {describe_views(int(end[0][SUBSET]), views)}"
        label = f"gap, {abs(train - test):.3g}{unit} at the end{which}"
    axes.fill_between([row["seconds"] for row in rows], *lines, color="gray", alpha=0.2, linewidth=0, label=label)


def main() -> None:
    """Draw for `CurveRecorder`."""
    gc.disable()  # for the second that this takes
    with contextlib.suppress(Exception):  # drawing reports it
        import matplotlib.backends.backend_agg  # noqa: F401
        import matplotlib.figure  # noqa: F401
    if sys.stdin.readline():
        source, target, title, *views = sys.argv[1:]
        try:
            draw_curve(target, read_curve(source), title, dict(zip(COLORS, map(int, views), strict=True)))
        except Exception as error:  # a broken matplotlib may raise anything, and the model is trained
            print(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
