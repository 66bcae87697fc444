"""Figures of the report: error against time of a scene, and its worst test views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from evaluation.contact_sheet import contact_sheet
from evaluation.model_folder import mask_of, picture
from evaluation.tradeoff import pareto_front
from records.error_curve import SUBSET, Row, whole_sets
from records.plain_log_axis import plain_log_axis
from utils.system_utils import atomic_write

HOLLOW = {"fillstyle": "none", "linewidth": 0.6, "markersize": 4}  # points of subsets
WIDEST = 480  # largest width, in pixels, of an image on a sheet


def _psnr(row: Row, views: str) -> float | None:
    return row[f"{views}_psnr"]


def _dissimilarity(row: Row, views: str) -> float | None:
    ssim = row[f"{views}_ssim"]
    return None if ssim is None else 1 - ssim


def draw_curves(path: Path, scene: str, runs: Sequence[dict[str, Any]]) -> bool:
    """Draw test PSNR and 1 - SSIM of a scene's runs against seconds of training; return False if no run has a curve.

    Each option set has a colour and each seed a line. With several option sets, the Pareto front of all points is
    marked. With one, the training views are drawn too, dashed, so that over-fitting shows. Points that score a subset
    of the views are hollow, on a thin line of their own, and in no front.
    """
    from matplotlib.figure import Figure  # imported here because only a report needs it

    runs = [run for run in runs if any(row["test_psnr"] is not None for row in run["curve"])]
    if not runs:
        return False
    configs = list(dict.fromkeys(run["config"] for run in runs))
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    figure.suptitle(f"{scene}: error against time")
    panels = ((_psnr, "PSNR of the test views (dB)", -1), (_dissimilarity, "1 - SSIM of the test views", 1))
    for axes, (value, label, sign) in zip(figure.subplots(1, 2), panels, strict=True):
        every: list[tuple[float, float]] = []
        for run in runs:
            index = configs.index(run["config"])
            first = run is next(other for other in runs if other["config"] == run["config"])
            points = _points(whole_sets(run["curve"]), value, "test")
            every += points
            style = {"color": f"C{index % 10}", "linestyle": ("-", "-.", ":")[index // 10 % 3], "linewidth": 1.2}
            axes.plot(*_columns(points), marker=".", label=(run["config"] or "test") if first else None, **style)
            parts = [row for row in run["curve"] if row.get(SUBSET) is not None]
            if part := _points(parts, value, "test"):
                named = "a subset of the test views" if run is runs[0] else None
                axes.plot(*_columns(part), marker="o", label=named, **style | HOLLOW)
            if len(configs) == 1 and (train := _points(whole_sets(run["curve"]), value, "train")):
                style |= {"linestyle": "--", "alpha": 0.6}
                axes.plot(*_columns(train), label="train" if first else None, **style)
                axes.plot(*_columns(_points(parts, value, "train")), marker="o", **style | HOLLOW)
        if len(configs) > 1:
            front = [every[i] for i in pareto_front([(seconds, sign * number) for seconds, number in every])]
            axes.plot(
                *_columns(_stairs(front)), color="black", linewidth=0.6, marker="o", markevery=2,
                markerfacecolor="none", markersize=8, label="Pareto front",
            )  # fmt: skip
        axes.set(xscale="log", xlabel="seconds of training, without scoring and saving", ylabel=label)
        plain_log_axis(axes.xaxis)
        if value is _dissimilarity and every and all(number > 0 for _, number in every):
            axes.set_yscale("log")
            plain_log_axis(axes.yaxis)
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize="small")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})
    return True


def _points(curve: Sequence[Row], value: Callable[[Row, str], float | None], views: str) -> list[tuple[float, float]]:
    pairs = ((row["seconds"], value(row, views)) for row in curve)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _stairs(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points with a corner between each two, so that every second one is a point.

    Matplotlib places its legend clear of these, but not of lines that it draws with drawstyle "steps".
    """
    corners = [(after[0], before[1]) for before, after in zip(points, points[1:], strict=False)]
    return [point for pair in zip(points, corners, strict=False) for point in pair] + list(points[-1:])


def _what_counts(method: Path, side: str, name: str) -> Image.Image:
    image, mask = picture(method / side / name), mask_of(method, name)
    if mask is None:
        return image
    return Image.fromarray(np.where(mask[..., None], np.asarray(image), np.uint8(255)))


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
            *(_what_counts(folder, side, view["file"]) for side in ("gt", "renders")),
        )
        for view in run["worst_views"]
    ]
    with atomic_write(path) as temporary:
        contact_sheet(rows, WIDEST).save(temporary)
    return True
