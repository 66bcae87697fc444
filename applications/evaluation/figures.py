"""Figures of a report: test views of several trainings against time, size and poses, and cameras from above."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from splatting.records.error_curve import Row, common_subset, rows_on, whole_sets
from splatting.records.figures import (
    COLORS,
    HOLLOW,
    Point,
    Value,
    describe_views,
    dissimilarity,
    draw_line,
    forget_settings,
    label_axes,
    line_of,
    make_figure,
    psnr,
    save_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STYLES = ("-", "-.", ":")
PEER_MARKERS = "xs^vDP*"
SECONDS = "seconds of training"
PANEL, DPI, FONT = (5.6, 4.2), 140, 12  # inches, and letters to be read at half the size, too
SAME = 1.02  # times as many Gaussians, or fewer, are the same number
LEGEND = 72  # letters in a line of a legend


def _draw_panel(path: Path, title: str, log: bool, labels: tuple[str, str], draw: Callable[[Axes], str | None]) -> Path:
    """Write a figure of one panel, whose legend lies below it.

    log: true if the y axis is logarithmic.
    draw: function that draws into axes, and returns the legend's title.
    """
    from matplotlib import rc_context

    forget_settings()
    with rc_context({"font.size": FONT}):
        figure, axes = make_figure(1, PANEL, title)
        said = draw(axes)
        label_axes(axes, *labels, log=log)
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
    said = describe_views(subset, counts.pop() if len(counts) == 1 else None)
    said += "" if subset is None else f"; hollow{' and other programs' if peers else ''}: all of them"
    said += _describe_seeds(runs, subset)

    def draw(axes: Axes, value: Value) -> str:
        _draw_runs(axes, runs, value, several, subset)
        _draw_peers(axes, peers, value)
        return said

    x = SECONDS + (" (other programs: as they count)" if peers else "")
    panels = {"psnr": (psnr, "PSNR of the test views (dB)"), "ssim": (dissimilarity, "1 - SSIM of the test views")}
    return [
        _draw_panel(folder / f"{scene}_{name}.png", scene, name != "psnr", (x, y), partial(draw, value=value))
        for name, (value, y) in (panels.items() if runs else ())
    ]


def _describe_seeds(runs: Sequence[dict[str, Any]], subset: int | None) -> str:
    """Say how the seeds of option sets are drawn; empty without several."""
    curves: dict[str, list[Sequence[Row]]] = {}
    for run in runs:
        curves.setdefault(run["config"], []).append(rows_on(run["curve"], subset))
    several = [of_set for of_set in curves.values() if len(of_set) > 1]
    if not several:
        return ""
    return "\nmean of the seeds, band: all of them" if all(map(_are_alike, several)) else "\na line for each seed"


def draw_sizes(folder: Path, scene: str, runs: Sequence[dict[str, Any]]) -> list[Path]:
    """Draw the test PSNR of a scene's runs against their numbers of Gaussians; return a list with the file.

    The list is empty, and nothing is drawn, with one option set only, or if all numbers are nearly the same (SAME).
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
            draw_line(axes, sorted(points), None if again else name, **style)

    labels = "thousands of Gaussians", "PSNR of the test views (dB)"
    counts = [count for points in lines.values() for count, _ in points]
    several = lines and len({run["config"] for run in runs}) > 1 and max(counts) > SAME * min(counts)
    return [_draw_panel(folder / f"{scene}_size.png", scene, False, labels, draw)] if several else []


def draw_poses(folder: Path, scene: str, runs: Sequence[dict[str, Any]]) -> list[Path]:
    """Draw how far refined poses have turned, on the mean, against seconds of training; return the file, if any."""
    shown = [run for run in runs if run.get("poses")]  # reports of older versions lack it
    configs = list(dict.fromkeys(run["config"] for run in shown))

    def draw(axes: Axes) -> None:
        """Draw a line for each run, with the name of its option set once."""
        for place, run in enumerate(shown):
            again = any(run["config"] == other["config"] for other in shown[:place])
            style = {"color": f"C{configs.index(run['config']) % 10}", "marker": "o", "markersize": 3.5}
            points = [(seconds, degrees) for seconds, degrees, _ in run["poses"]]
            draw_line(axes, points, None if again else run["config"] or "training views", **style)

    labels = SECONDS, "mean turn of the training views (degrees)"
    return [_draw_panel(folder / f"{scene}_poses.png", scene, False, labels, draw)] if shown else []


def draw_cameras(folder: Path, scene: str, splits: Mapping[str, Sequence[Any]]) -> list[Path]:
    """Draw the cameras of each split from above; return the files.

    splits: for each split by its name, arrays (N, 4) of test and of training cameras: two coordinates, and two of the
        optical axis.
    """
    from matplotlib import rc_context

    paths = []
    for number, (split, both) in enumerate(splits.items(), start=1):
        with rc_context({"font.size": FONT}):
            figure, axes = make_figure(1, PANEL, f"{scene}: {split}")
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
                draw_line(axes, line_of(whole_sets(run["curve"]), value, "test"), None, **style | HOLLOW)
        if not several and max(len(line_of(rows, value, "train")) for rows in curves) > 1:
            dashed = style | {"marker": "", "linestyle": "--", "alpha": 0.6}
            _draw_seeds(axes, curves, value, "train", "training views", dashed)


def _are_alike(curves: Sequence[Sequence[Row]]) -> bool:
    """Tell whether several curves have the same iterations, at which their means are known."""
    return len(curves) > 1 and len({tuple(row["iteration"] for row in rows) for rows in curves}) == 1


def _draw_seeds(
    axes: Axes, curves: Sequence[Sequence[Row]], value: Value, views: str, name: str, style: dict[str, Any]
) -> None:
    """Draw the mean of curves that are alike, with a band from the lowest to the highest; or else each curve."""
    lines = [line_of(rows, value, views) for rows in curves]
    if _are_alike(curves) and len({*map(len, lines)}) == 1:
        columns = [[*zip(*points, strict=True)] for points in zip(*lines, strict=True)]
        seconds, values = [fmean(x) for x, _ in columns], [y for _, y in columns]
        axes.fill_between(
            seconds, [*map(min, values)], [*map(max, values)], color=style["color"], alpha=0.2, linewidth=0
        )
        lines = [[*zip(seconds, map(fmean, values), strict=True)]]
    for number, points in enumerate(lines):
        draw_line(axes, points, None if number else name, **style)


def _draw_peers(axes: Axes, peers: Sequence[dict[str, Any]], value: Value) -> None:
    """Draw other programs' curves."""
    found = [(peer["name"], points) for peer in peers if (points := line_of(whole_sets(peer["curve"]), value, "test"))]
    for index, (name, points) in enumerate(found):
        draw_line(
            axes, points, f"{name} (another program)", color="0.35", linestyle="--",
            marker=PEER_MARKERS[index % len(PEER_MARKERS)], markersize=5, linewidth=1.2,
        )  # fmt: skip
