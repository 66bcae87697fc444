"""Draw error against run time of strategies, from files of `benchmarks.strategies.trainings`.

    python -m benchmarks.strategies.figure docs/curves/strategies.png OUT/trainings.json ... --leave_out adc-absgrad \
        --peer fox_full/gsplat seed0/peer.csv seed1/peer.csv

A panel for each scene. Lines are fixed settings and other programs: the mean test PSNR over the seeds, between the
least and the largest, with a square at the mean end. Squares without a line are trainings of which only the ends are
known. Dots are time budgets: the mean and the range of their ends. Leave out sets whose trainings shared a GPU, as
their seconds mean nothing.
"""

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.strategies.tables import BUDGET, DEFAULT, at, joined
from splatting.evaluation.error_curve import read_peer
from utils.system_utils import UserError, atomic_write, run_cli

_TIMES = 300  # of a line
_SHOWN = 5.0  # dB below the best of a scene
_CURVE = 3  # points of a line; fewer are ends of trainings, each by itself
_COLORS = {"adc": "tab:blue", "budget": "black", "mcmc": "tab:red"}  # of time budgets, by strategy


def draw(found: dict, path: Path, left_out: Sequence[str] = ()) -> None:
    """Draw the records of `benchmarks.strategies.tables.joined`. left_out: names of sets."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    scenes = {scene: _runs(sets, left_out) for scene, sets in found["scenes"].items()}
    scenes = {scene: runs for scene, runs in scenes.items() if runs}
    if not scenes:
        raise UserError("no training is left to draw; name files with trainings that ended, or leave out fewer sets")
    budgets = {name: _strategy(words) for name, words in found["sets"].items() if BUDGET in words}
    lines = [name for name in found["sets"] if name not in budgets and any(name in runs for runs in scenes.values())]
    palette = colormaps["tab20" if len(lines) > 8 else "Set2"].colors
    peers = found.get("peers", ())
    ours = "our " if peers else ""
    figure = Figure(figsize=(13, 4 * ((len(scenes) + 1) // 2)), layout="constrained")
    panels = figure.subplots((len(scenes) + 1) // 2, 2, squeeze=False).flat
    for panel, (scene, runs) in zip(panels, scenes.items(), strict=False):
        for number, name in enumerate(lines):
            if name in runs:
                label, curves = name if name in peers else ours + name, [run["curve"] for run in runs[name]]
                _draw_line(panel, label, curves, palette[number % len(palette)])
        for strategy, color in _COLORS.items():
            ends = [runs[name] for name, of in budgets.items() if of == strategy and name in runs]
            _draw_dots(panel, f"{ours}{strategy} by the clock", ends, color)
        _fit(panel, [row for name in runs for run in runs[name] for row in _drawn(run, name in budgets)])
        panel.set(title=scene, xlabel="seconds of training", ylabel="PSNR of test views (dB)")
    for panel in panels:
        panel.set_axis_off()  # one too many
    shown = {}
    for panel in figure.axes:
        shown |= dict(zip(*reversed(panel.get_legend_handles_labels()), strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=5)
    figure.suptitle(found["machine"], fontsize=6)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=90)


def with_peers(found: dict, given: Sequence[Sequence[str]]) -> dict:
    """Add other programs as sets without options. given: "SCENE/NAME" and the curves (`read_peer`) of its seeds."""
    for title, *files in given:
        scene, _, name = title.rpartition("/")
        if scene not in found["scenes"] or not name or not files:
            there = ", ".join(found["scenes"])
            raise UserError(f"--peer {title}: give SCENE/NAME, of the scenes {there}, and the CSV file of each seed")
        curves = [[row | {"whole": True} for row in read_peer(Path(file))] for file in files]
        found["sets"].setdefault(name, [])
        found.setdefault("peers", []).append(name)
        found["scenes"][scene][name] = {str(seed): {"curve": curve} for seed, curve in enumerate(curves)}
    return found


def _runs(sets: dict, left_out: Sequence[str]) -> dict[str, list[dict]]:
    """The trainings of a scene by set, each with the points of its curve that score all test views; none without."""
    found = {}
    for name, seeds in sets.items():
        runs = [{"curve": [row for row in run["curve"] if row["whole"]]} for run in seeds.values() if run]
        if name not in left_out and (runs := [run for run in runs if run["curve"]]):
            found[name] = runs
    return found


def _strategy(words: Sequence[str]) -> str:
    return words[words.index("--strategy") + 1] if "--strategy" in words else DEFAULT


def _drawn(run: dict, is_budget: bool) -> list[dict]:
    return run["curve"][-1:] if is_budget else run["curve"]


def _fit(panel: Any, rows: Sequence[dict]) -> None:
    """Show what is near the best of the points drawn."""
    best = max(row["test_psnr"] for row in rows)
    panel.set_xscale("log")
    panel.set_xlim(left=0.9 * min(row["seconds"] for row in rows if row["test_psnr"] > best - _SHOWN))
    panel.set_ylim(best - _SHOWN, best + 0.1 * _SHOWN)
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter("")
    panel.grid(alpha=0.3, which="both")


def _draw_line(panel: Any, name: str, curves: Sequence[Sequence[dict]], color: Any) -> None:
    """Draw the mean of the curves from where all have begun to where the first ends, and the mean end."""
    if max(map(len, curves)) < _CURVE:
        ends = zip(*((row["seconds"], row["test_psnr"]) for rows in curves for row in rows), strict=True)
        panel.plot(*ends, color=color, marker="s", linestyle="", label=name)
        return
    end = [statistics.fmean(rows[-1][key] for rows in curves) for key in ("seconds", "test_psnr")]
    panel.plot(*end, color=color, marker="s", label=name)
    first, last = max(rows[0]["seconds"] for rows in curves), min(rows[-1]["seconds"] for rows in curves)
    if first < last:
        times = [first * (last / first) ** (step / _TIMES) for step in range(_TIMES)] + [last]
        values = [[at(rows, time) for rows in curves] for time in times]
        panel.plot(times, list(map(statistics.fmean, values)), color=color)
        panel.fill_between(times, list(map(min, values)), list(map(max, values)), color=color, alpha=0.3, linewidth=0)


def _draw_dots(panel: Any, name: str, budgets: Sequence[Sequence[dict]], color: str) -> None:
    """Draw a dot for each time budget, where its trainings ended."""
    ends = [[run["curve"][-1] for run in runs] for runs in budgets]
    points = sorted((statistics.fmean(end["seconds"] for end in of), [end["test_psnr"] for end in of]) for of in ends)
    if not points:
        return
    times, values = zip(*points, strict=True)
    means = list(map(statistics.fmean, values))
    down = [mean - min(of) for mean, of in zip(means, values, strict=True)]
    up = [max(of) - mean for mean, of in zip(means, values, strict=True)]
    panel.errorbar(times, means, [down, up], color=color, marker="o", linestyle=":", label=name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("figure", type=Path, help="image file to write")
    add("files", type=Path, nargs="+", help="trainings.json of benchmarks.strategies.trainings")
    add("--leave_out", nargs="+", default=[], metavar="SET", help="names of sets that are not drawn (default: none)")
    add("--peer", nargs="+", action="append", default=[], metavar=("SCENE/NAME", "FILE"),
        help="another program on a scene: the CSV file of each seed, as for full_eval.py (default: none)")  # fmt: skip
    args = parser.parse_args()
    found = joined([json.loads(path.read_text()) for path in args.files])
    draw(with_peers(found, args.peer), args.figure, args.leave_out)


if __name__ == "__main__":
    run_cli(main)
