"""Figure of a scene's Pareto fronts: where each option set ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.figures import draw_front
from evaluation.fronts import COSTS
from evaluation.printable import printable
from records.plain_log_axis import plain_log_axis
from utils.system_utils import atomic_write

MARKERS = "osD"  # with ten colours they tell thirty sets apart
LABELS = {
    "seconds": "seconds of training, without scoring and saving",
    "gaussians": "Gaussians, as trained",
    "ply_mb": "megabytes of the PLY",
}


def draw_fronts(path: Path, scene: str, found: Mapping[str, Any], names: Sequence[str]) -> None:
    """Draw PSNR against each cost.

    found: the scene's `fronts` in report.json. names: all option sets of the scene, which colours follow, so that they
    are those of the curves. A point is the mean over the seeds, a bar the standard deviation; the front goes
    through the means.
    """
    from matplotlib.figure import Figure  # imported here because only a report needs it

    figure = Figure(figsize=(6 * len(COSTS), 4.8), layout="constrained")
    figure.suptitle(f"{printable(scene)}: where each option set ended")
    for axes, cost in zip(figure.subplots(1, len(COSTS)), COSTS, strict=True):
        points = []
        for name, point in found["sets"].items():
            index = names.index(name)
            x, y = point[cost], point["PSNR"]
            points.append((x["mean"], y["mean"]))
            axes.errorbar(
                *points[-1], xerr=x["std"], yerr=y["std"], label=printable(name), color=f"C{index % 10}",
                marker=MARKERS[index // 10 % len(MARKERS)], markersize=5, linewidth=1, capsize=2,
            )  # fmt: skip
        draw_front(axes, points, -1)
        axes.set(xscale="log", xlabel=LABELS[cost], ylabel="PSNR of the test views (dB)")
        plain_log_axis(axes.xaxis)
        axes.grid(True, which="both", alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})
