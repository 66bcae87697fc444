"""Draw error against run time of strategies, from files of `benchmarks.strategies.trainings`.

    python -m benchmarks.strategies.figure docs/curves/strategies.png OUT/trainings.json ...

A panel for each scene. Lines are fixed settings: the mean test PSNR over the seeds, between the least and the largest,
with a square at the mean end. Dots are time budgets, with the same at their end. Sets with a part of the default's
Gaussians are left out, as those may have shared a GPU.
"""

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.accuracy.figure import require_matplotlib
from benchmarks.strategies.tables import BUDGET, at, joined
from utils.system_utils import atomic_write, run_cli

_TIMES = 300  # of a line
_SHOWN = 5.0  # dB below the best of a scene
_COLORS = {"budget": "black", "mcmc": "tab:red"}  # of time budgets, by strategy


def draw(found: dict, path: Path) -> None:
    """Draw the records of `benchmarks.strategies.tables.joined`."""
    require_matplotlib()
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    sets = {name: words for name, words in found["sets"].items() if "% of gaussians" not in " ".join(words)}
    lines = [name for name, words in sets.items() if BUDGET not in words]
    colors = dict(zip(lines, colormaps["Set2"].colors, strict=False))
    down = (len(found["scenes"]) + 1) // 2
    figure = Figure(figsize=(13, 4 * down), layout="constrained")
    panels = figure.subplots(down, 2, squeeze=False).flat
    for panel, (scene, by_set) in zip(panels, found["scenes"].items(), strict=False):
        runs = {name: [run for run in by_set.get(name, {}).values() if run] for name in sets}
        for name in lines:
            _draw_line(panel, name, [run["curve"] for run in runs[name]], colors[name])
        for strategy, color in _COLORS.items():
            budgets = [name for name, words in sets.items() if BUDGET in words and strategy in words]
            _draw_marks(panel, strategy, [[run["end"] for run in runs[name]] for name in budgets], color)
        rows = [row for of_set in runs.values() for run in of_set for row in run["curve"]]
        best = max(row["test_psnr"] for row in rows)
        panel.set(xscale="log", title=scene, xlabel="seconds of training", ylabel="PSNR of test views (dB)")
        panel.set_xlim(left=min(row["seconds"] for row in rows if row["test_psnr"] > best - _SHOWN))
        panel.set_ylim(best - _SHOWN, best + 0.1 * _SHOWN)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
        panel.grid(alpha=0.3, which="both")
    shown = {}
    for panel in figure.axes:
        shown |= dict(zip(*reversed(panel.get_legend_handles_labels()), strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=6)
    figure.suptitle(found["machine"], fontsize=7)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=90)


def _draw_line(panel: Any, name: str, curves: Sequence[Sequence[dict]], color: Any) -> None:
    """Draw the mean of the curves from where all have begun to where the first ends, and the mean end."""
    scored = [[row for row in curve if row["whole"]] for curve in curves]
    if not scored:
        return
    end = [statistics.fmean(rows[-1][key] for rows in scored) for key in ("seconds", "test_psnr")]
    panel.plot(*end, color=color, marker="s", label=name)
    first, last = max(rows[0]["seconds"] for rows in scored), min(rows[-1]["seconds"] for rows in scored)
    if first < last:
        times = [first * (last / first) ** (step / _TIMES) for step in range(_TIMES)] + [last]
        values = [[at(rows, time) for rows in scored] for time in times]
        panel.plot(times, list(map(statistics.fmean, values)), color=color)
        panel.fill_between(times, list(map(min, values)), list(map(max, values)), color=color, alpha=0.3, linewidth=0)


def _draw_marks(panel: Any, strategy: str, budgets: Sequence[Sequence[dict]], color: str) -> None:
    """Draw a mark for each time budget, where its trainings ended."""
    points = sorted(
        (statistics.fmean(end["seconds"] for end in ends), [end["test_psnr"] for end in ends])
        for ends in budgets
        if ends
    )
    if not points:
        return
    times, values = zip(*points, strict=True)
    means = list(map(statistics.fmean, values))
    reach = [
        [mean - min(of) for mean, of in zip(means, values, strict=True)],
        [max(of) - mean for mean, of in zip(means, values, strict=True)],
    ]
    panel.errorbar(times, means, reach, color=color, marker="o", linestyle=":", label=f"{strategy} by the clock")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", type=Path, help="image file to write")
    parser.add_argument("files", type=Path, nargs="+", help="trainings.json of benchmarks.strategies.trainings")
    args = parser.parse_args()
    draw(joined([json.loads(path.read_text()) for path in args.files]), args.figure)


if __name__ == "__main__":
    run_cli(main)
