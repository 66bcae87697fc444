"""Seconds until trainings are near the best known PSNR of their scene: table, distribution, performance profile.

    python -m benchmarks.peers.targets FOLDER ... --stored benchmarks/peers --figures OUT

A FOLDER is laid out as full_eval.py's output: SCENE[/PROGRAM][/seed_N] has error_vs_time.csv, or peer.csv of another
program. Without PROGRAM it is "ours". --stored adds curves of the same scenes that lie as PROGRAM/SCENE.csv, or
PROGRAM/SCENE/RUN.csv where RUN is [STRATEGY_]seedN. The best known of a scene is the highest test PSNR of all these
curves. Writes time_to_target.png and performance_profile.png into OUT. Seconds compare only on one kind of machine.
"""

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.harness.measuring import print_table
from benchmarks.peers.curve import CURVE
from benchmarks.peers.time_to_target import (
    TARGETS,
    Curve,
    Steps,
    best_known,
    choose_comparable,
    ecdf,
    measure_times,
    performance_profile,
    summarise_reached,
)
from splatting.records.error_curve import NAME, read_peer
from splatting.records.figures import save_figure
from utils.system_utils import UserError, mkdir_p, run_cli

LINES = ("-", "--", ":")  # with ten colours for thirty programs
MARGIN = 1.15  # of the axis of x, as a factor
_SEED = re.compile(r"seed_\d+")
_STORED = re.compile(r"(?:(.+)_)?seed\d+")


def read_curve(file: Path, scene: str, program: str, run: str) -> Curve:
    """Read the points of a file that score all test views."""
    return Curve(scene, program, run, [(row["seconds"], row["test_psnr"]) for row in read_peer(file)])


def read_curves(folder: Path) -> list[Curve]:
    """Read the curves of a folder that is laid out as full_eval.py's output. UserError if it has none."""
    found = []
    for file in sorted([*folder.glob(f"*/**/{NAME}"), *folder.glob(f"*/**/{CURVE}")]):
        scene, *rest = file.relative_to(folder).parts[:-1]
        run = rest.pop() if rest and _SEED.fullmatch(rest[-1]) else ""
        found.append(read_curve(file, scene, "/".join(rest) or "ours", run))
    if not found:
        raise UserError(f"{folder} has no SCENE[/PROGRAM][/seed_N]/{NAME} or {CURVE}; give an output of full_eval.py")
    return found


def read_stored(folder: Path, scenes: Sequence[str]) -> list[Curve]:
    """Read the stored curves of other programs on these scenes."""
    found = []
    for scene in scenes:
        found += [read_curve(file, scene, file.parent.name, "") for file in sorted(folder.glob(f"*/{scene}.csv"))]
        for file in sorted(folder.glob(f"*/{scene}/*.csv")):
            if name := _STORED.fullmatch(file.stem):
                found.append(
                    read_curve(file, scene, " ".join(filter(None, (file.parents[1].name, name[1]))), file.stem)
                )
    return found


def _make_rows(curves: Sequence[Curve], by_target: Mapping[float, Mapping[str, Sequence[float]]]) -> list[list[str]]:
    """Return a row for each program: its curves, its fewest points, and its trainings that reached each target.

    by_target: seconds of each training until its target, infinite if it never got there, by target and program.
    """
    rows = []
    for program in dict.fromkeys(curve.program for curve in curves):
        own = [len(curve.points) for curve in curves if curve.program == program]
        row = [program, str(len(own)), str(min(own))]
        for seconds in by_target.values():
            count, median = summarise_reached(seconds[program])
            row += [
                f"{100 * count / len(seconds[program]):.0f} %",
                f"{median:.1f}" if math.isfinite(median) else "never",
            ]
        rows.append(row)
    return rows


def draw(path: Path, panels: Mapping[str, Mapping[str, Steps]], x: str, y: str) -> None:
    """Draw shares as steps, a panel for each title."""
    from matplotlib.figure import Figure

    places = [place for lines in panels.values() for where, _ in lines.values() for place in where] or [1.0]
    begin, end = min(places) / MARGIN, max(places) * MARGIN
    figure = Figure(figsize=(3.3 + 3.7 * len(panels), 5.0), layout="constrained")
    for axes, (title, lines) in zip(
        figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels.items(), strict=True
    ):
        for n, (name, (where, shares)) in enumerate(lines.items()):
            style = {"color": f"C{n % 10}", "linestyle": LINES[n // 10 % len(LINES)], "label": name}
            axes.step([begin, *where, end], [0.0, *shares, [0.0, *shares][-1]], where="post", **style)
        axes.set(xscale="log", ylim=(-0.02, 1.02), title=title, xlabel=x)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(True, which="both", alpha=0.3, linewidth=0.5)
    figure.axes[0].set_ylabel(y)
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2 * len(panels), fontsize=9)
    save_figure(figure, path, 140)


def main() -> None:
    """Print when the curves of the folders reach their targets, and draw the distributions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="outputs of full_eval.py, or alike")
    parser.add_argument("--stored", type=Path, metavar="FOLDER", help="curves of other programs (default: none)")
    parser.add_argument("--figures", type=Path, metavar="OUT", required=True, help="folder to write the figures into")
    args = parser.parse_args()
    given = [curve for folder in args.folders for curve in read_curves(folder)]
    if args.stored:
        given += read_stored(args.stored, list(dict.fromkeys(curve.scene for curve in given)))
    names = [curve[:3] for curve in given]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(f"two curves are of {' '.join(filter(None, twice[0]))}; give each run a folder of its own")
    best, (curves, left_out) = best_known(given), choose_comparable(given)
    if not curves:
        raise UserError("no program has all scenes; give folders of fewer scenes")
    print_table(["scene", "best known (dB)", "by"], [[name, f"{psnr:.2f}", by] for name, (psnr, by) in best.items()])
    if left_out:
        print(f"\nLeft out, as they lack a scene: {', '.join(left_out)}.")
    by_target = {target: measure_times(curves, best, target) for target in TARGETS}
    print()
    head = [text for target in TARGETS for text in (f"within {target:g} dB", "median (s)")]
    print_table(["program", "runs", "fewest samples", *head], _make_rows(curves, by_target))
    print("\nOf all runs: one that never arrives counts as never. The first sample counts; nothing is interpolated.")
    mkdir_p(args.figures)
    panels = {
        f"within {target:g} dB of the best known": {name: ecdf(values) for name, values in seconds.items()}
        for target, seconds in by_target.items()
    }
    draw(args.figures / "time_to_target.png", panels, "seconds of training", "share of runs that are there")
    profile = {f"scenes, and targets of {', '.join(map(str, TARGETS))} dB": performance_profile(curves, best)}
    x = "seconds, as a multiple of the fastest program's"
    draw(args.figures / "performance_profile.png", profile, x, "share of scenes with targets")


if __name__ == "__main__":
    run_cli(main)
