"""Figures of error against time: error_vs_time.png of a training, and those of a report.

`python -m splatting.records.figures CSV PNG TITLE TEST_VIEWS TRAIN_VIEWS` draws a training's curve for
curve_recorder.py. It imports matplotlib, waits for a line on its standard input, draws, and prints what went wrong;
without a line it draws nothing.
"""

from __future__ import annotations

import contextlib
import gc
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from groundwork.host.listing import as_utf8
from splatting.records.error_curve import SUBSET, Row, best_test, common_subset, read_curve, rows_on, whole_sets
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {"test": "#0072B2", "train": "#D55E00"}  # told apart by the colour-blind (Okabe and Ito)
STYLES = ("-", "-.", ":")
PEER_MARKERS = "xs^vDP*"
SECONDS = "seconds of training"
PANEL, DPI, FONT = (5.6, 4.2), 140, 12  # of a report's figure: inches, and letters to be read at half the size, too
HOLLOW = {"linestyle": ":", "linewidth": 1, "markerfacecolor": "white", "zorder": 3}  # whole sets beside a subset
SAME = 1.02  # times as many Gaussians, or fewer, are the same number
LEGEND = 72  # letters in a line of a legend

Value = Callable[[Row, str], float | None]
Point = tuple[float, float]


def psnr(row: Row, views: str) -> float | None:
    return row[f"{views}_psnr"]


def dissimilarity(row: Row, views: str) -> float | None:
    """Return 1 - SSIM; None for equal images, which have no place on a logarithmic axis."""
    ssim = row[f"{views}_ssim"]
    return None if ssim is None or ssim >= 1 else 1 - ssim


def _points(rows: Sequence[Row], value: Value, views: str) -> list[Point]:
    """Return seconds and values of the rows that have both; seconds must be above 0 on a logarithmic axis."""
    pairs = ((row["seconds"], value(row, views)) for row in rows)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def _draw(axes: Axes, points: Sequence[Point], label: str | None, **style: Any) -> None:
    axes.plot([x for x, _ in points], [y for _, y in points], label=label and as_utf8(label), **style)


def _views_text(subset: int | None, count: int | None, kind: str = "test") -> str:
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


def _label(axes: Axes, x: str, y: str, log: bool = False) -> None:
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
def _forget_settings() -> None:
    """Forget the settings of a matplotlibrc in the folder that a user works in, which may call for TeX."""
    from matplotlib import rcdefaults

    rcdefaults()


def _figure(rows: int, size: tuple[float, float], title: str) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure  # imported here: it takes long, and most programs draw nothing

    _forget_settings()
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
    figure, (upper, lower) = _figure(2, (7.5, 7.0), title)
    subsets = {int(row[SUBSET]) for row in rows if row[SUBSET] is not None}
    main = common_subset([rows])
    for axes, value, unit in ((upper, psnr, " dB"), (lower, dissimilarity, "")):
        for subset in (*sorted(subsets), None):
            for name, color in COLORS.items():
                style = HOLLOW if subset is None and subsets else {"linewidth": 1.2}
                points = _points(rows_on(rows, subset), value, name)
                label = _views_text(subset, views[name], name) if points or subset is None else None
                _draw(axes, points, label, **{"marker": "o", "markersize": 4, "color": color} | style)
        scored = [row for row in rows if row["seconds"] > 0 and None not in [value(row, name) for name in COLORS]]
        both = rows_on(scored, main)
        _shade_gap(axes, both, scored[-1:] or both, value, unit, views["test"])
    if len(whole_sets(rows)) > 1 and (best := best_test(rows)):
        label = f"highest mean over all test views: {best['test_psnr']:.2f} dB, iteration {best['iteration']:,}"
        _draw(
            upper, [(best["seconds"], best["test_psnr"])], label, marker="*", color="black", markersize=12, linestyle=""
        )
    _label(upper, "", "PSNR (dB)")
    _label(lower, "seconds of training, without scoring and saving", "1 - SSIM", log=True)
    for axes, below in ((upper, -0.05), (lower, -0.2)):  # the label of the lower axis is between
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncols=2, frameon=False)
    save_figure(figure, path)


def _shade_gap(axes: Axes, rows: Sequence[Row], end: Sequence[Row], value: Value, unit: str, views: int) -> None:
    """Shade the gap between test and train views at rows that have both, and state the gap of the last row, `end`."""
    lines, label = [[value(row, name) for row in rows] for name in COLORS], None
    if len(rows) > 1:
        test, train = (value(end[0], name) for name in COLORS)
        which = "" if end[0][SUBSET] is None else f", {_views_text(int(end[0][SUBSET]), views)}"
        label = f"gap, {abs(train - test):.3g}{unit} at the end{which}"
    axes.fill_between([row["seconds"] for row in rows], *lines, color="gray", alpha=0.2, linewidth=0, label=label)


def _panel(path: Path, title: str, log: bool, labels: tuple[str, str], draw: Callable[[Axes], str | None]) -> Path:
    """Write a figure of one panel, whose legend lies below it.

    log: true if the y axis is logarithmic.
    draw: function that draws into axes, and returns the legend's title.
    """
    from matplotlib import rc_context

    _forget_settings()
    with rc_context({"font.size": FONT}):
        figure, axes = _figure(1, PANEL, title)
        said = draw(axes)
        _label(axes, *labels, log=log)
        handles, names = axes.get_legend_handles_labels()
        columns = max(1, min(4, LEGEND // (6 + max(map(len, names), default=0))))
        legend = figure.legend(handles, names, title=said, loc="outside lower center", ncols=columns, fontsize=FONT - 2,
                               title_fontsize=FONT - 2, frameon=False)  # fmt: skip
        legend.get_title().set_multialignment("center")
        save_figure(figure, path, DPI)
    return path


def draw_curves(
    folder: Path, scene: str, runs: Sequence[dict[str, Any]], peers: Sequence[dict[str, Any]] = ()
) -> list[Path]:
    """Draw a scene's test PSNR and 1 - SSIM against seconds of training; return the files, none if no run has a curve.

    Each option set has a colour, and a line with a band for its seeds (`_draw_seeds`). Lines show the views on which
    all runs compare; if these are a subset, separate hollow points show the scores of all views. With one option set,
    the training views are drawn too, dashed.

    peers: curves of other programs, in grey.
    """
    runs = [run for run in runs if any(row["test_psnr"] is not None for row in run["curve"])]
    several = len({run["config"] for run in runs}) > 1
    counts = {run["views"]["test"] for run in runs}
    subset = common_subset(run["curve"] for run in runs if not run["apart"])
    said = _views_text(subset, counts.pop() if len(counts) == 1 else None)
    said += "" if subset is None else f"; hollow{' and other programs' if peers else ''}: all of them"
    said += _about_seeds(runs, subset)

    def draw(axes: Axes, value: Value) -> str:
        _draw_runs(axes, runs, value, several, subset)
        _draw_peers(axes, peers, value)
        return said

    x = SECONDS + (" (other programs: as they count)" if peers else "")
    panels = {"psnr": (psnr, "PSNR of the test views (dB)"), "ssim": (dissimilarity, "1 - SSIM of the test views")}
    return [
        _panel(folder / f"{scene}_{name}.png", scene, name != "psnr", (x, y), partial(draw, value=value))
        for name, (value, y) in (panels.items() if runs else ())
    ]


def _about_seeds(runs: Sequence[dict[str, Any]], subset: int | None) -> str:
    """Say how the seeds of option sets are drawn; empty without several."""
    curves: dict[str, list[Sequence[Row]]] = {}
    for run in runs:
        curves.setdefault(run["config"], []).append(rows_on(run["curve"], subset))
    several = [of_set for of_set in curves.values() if len(of_set) > 1]
    if not several:
        return ""
    return "\nmean of the seeds, band: all of them" if all(map(_are_alike, several)) else "\na line for each seed"


def draw_sizes(folder: Path, scene: str, runs: Sequence[dict[str, Any]]) -> list[Path]:
    """Draw test PSNR against the number of Gaussians trained; return the file, none where the number is the same.

    Option sets whose names differ only in a number at the end, as adc-100k and adc-1M, are joined by a line for each
    seed.
    """
    lines: dict[tuple[str, Any], list[Point]] = {}
    for run in runs:
        end = run["iterations"].get(str(run["final_iteration"]), {})
        if end.get("PSNR") is not None and end["gaussians"] and not run["apart"]:
            name = run["config"] or "no option set"
            line = lines.setdefault((re.sub(r"(?<=.)-[\d.]+[kM]?$", "", name), run["seed"]), [])
            line.append((end["gaussians"] / 1000, end["PSNR"]))
    names = list(dict.fromkeys(name for name, _ in lines))

    def draw(axes: Axes) -> None:
        for (name, _), points in lines.items():
            again = name in axes.get_legend_handles_labels()[1]
            style = {"color": f"C{names.index(name) % 10}", "marker": "o", "markersize": 3.5, "linewidth": 1.2}
            _draw(axes, sorted(points), None if again else name, **style)

    labels = "thousands of Gaussians", "PSNR of the test views (dB)"
    counts = [count for points in lines.values() for count, _ in points]
    several = lines and len({run["config"] for run in runs}) > 1 and max(counts) > SAME * min(counts)
    return [_panel(folder / f"{scene}_size.png", scene, False, labels, draw)] if several else []


def draw_poses(folder: Path, scene: str, runs: Sequence[dict[str, Any]]) -> list[Path]:
    """Draw how far refined poses have turned, on the mean, against seconds of training; return the file, if any."""
    shown = [run for run in runs if run.get("poses")]  # reports of older versions lack it
    configs = list(dict.fromkeys(run["config"] for run in shown))

    def draw(axes: Axes) -> None:
        for place, run in enumerate(shown):
            again = any(run["config"] == other["config"] for other in shown[:place])
            style = {"color": f"C{configs.index(run['config']) % 10}", "marker": "o", "markersize": 3.5}
            points = [(seconds, degrees) for seconds, degrees, _ in run["poses"]]
            _draw(axes, points, None if again else run["config"] or "training views", **style)

    labels = SECONDS, "mean turn of the training views (degrees)"
    return [_panel(folder / f"{scene}_poses.png", scene, False, labels, draw)] if shown else []


def draw_cameras(folder: Path, scene: str, splits: Mapping[str, Sequence[Any]]) -> list[Path]:
    """Draw the cameras of each split from above; return the files.

    splits: for each split by its name, arrays (N, 4) of test and of training cameras: two coordinates, and two of the
        optical axis.
    """
    from matplotlib import rc_context

    paths = []
    for number, (split, both) in enumerate(splits.items(), start=1):
        with rc_context({"font.size": FONT}):
            figure, axes = _figure(1, PANEL, f"{scene}: {split}")
            for (name, color), cameras in reversed([*zip(COLORS.items(), both, strict=True)]):  # test views on top
                axes.quiver(*cameras.T, color=color, angles="xy", width=0.004, label=f"{len(cameras):,} {name} views")
            axes.set(aspect="equal", adjustable="datalim", xticks=[], yticks=[])
            figure.legend(loc="outside lower center", ncols=2, frameon=False)
            paths.append(folder / f"{scene}_cameras_{number}.png")
            save_figure(figure, paths[-1], DPI)
    return paths


def _draw_runs(axes: Axes, runs: Sequence[dict[str, Any]], value: Value, several: bool, subset: int | None) -> None:
    """Draw a line for each option set, or for each of its runs (`_draw_seeds`), and whole sets beside a subset."""
    sets: dict[tuple[Any, bool], list[dict[str, Any]]] = {}
    for run in runs:
        sets.setdefault((run["config"], run["finished"]), []).append(run)
    configs = list(dict.fromkeys(config for config, _ in sets))
    for (config, is_finished), members in sets.items():
        index = configs.index(config)
        name = config or ("no option set" if several else "test views")
        name += " (other ground truth)" if members[0]["apart"] else ""
        name += "" if is_finished else " (not finished)"
        style = {"color": f"C{index % 10}", "linestyle": STYLES[index // 10 % len(STYLES)], "linewidth": 1.2}
        style |= {
            "marker": "o" if is_finished else "x",
            "markersize": 3.5,
            "alpha": 0.4 if members[0]["apart"] else 1.0,
        }
        curves = [rows_on(run["curve"], subset) for run in members]
        _draw_seeds(axes, curves, value, "test", name, style)
        if subset is not None:
            for run in members:
                _draw(axes, _points(whole_sets(run["curve"]), value, "test"), None, **style | HOLLOW)
        if not several and max(len(_points(rows, value, "train")) for rows in curves) > 1:
            dashed = style | {"marker": "", "linestyle": "--", "alpha": 0.6}
            _draw_seeds(axes, curves, value, "train", "training views", dashed)


def _are_alike(curves: Sequence[Sequence[Row]]) -> bool:
    """Tell whether several curves have the same iterations, at which their means are known."""
    return len(curves) > 1 and len({tuple(row["iteration"] for row in rows) for rows in curves}) == 1


def _draw_seeds(
    axes: Axes, curves: Sequence[Sequence[Row]], value: Value, views: str, name: str, style: dict[str, Any]
) -> None:
    """Draw the mean of curves that are alike, with a band from the lowest to the highest; or else each curve."""
    lines = [_points(rows, value, views) for rows in curves]
    if _are_alike(curves) and len({*map(len, lines)}) == 1:
        columns = [[*zip(*points, strict=True)] for points in zip(*lines, strict=True)]
        seconds, values = [fmean(x) for x, _ in columns], [y for _, y in columns]
        axes.fill_between(
            seconds, [*map(min, values)], [*map(max, values)], color=style["color"], alpha=0.2, linewidth=0
        )
        lines = [[*zip(seconds, map(fmean, values), strict=True)]]
    for number, points in enumerate(lines):
        _draw(axes, points, None if number else name, **style)


def _draw_peers(axes: Axes, peers: Sequence[dict[str, Any]], value: Value) -> None:
    """Draw other programs' curves."""
    found = [(peer["name"], points) for peer in peers if (points := _points(whole_sets(peer["curve"]), value, "test"))]
    for index, (name, points) in enumerate(found):
        _draw(
            axes, points, f"{name} (another program)", color="0.35", linestyle="--",
            marker=PEER_MARKERS[index % len(PEER_MARKERS)], markersize=5, linewidth=1.2,
        )  # fmt: skip


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
