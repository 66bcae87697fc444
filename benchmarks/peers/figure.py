"""Draw test PSNR against seconds of training: ours, other programs on our photos, and published curves.

    python -m benchmarks.peers.figure PNG --title TITLE --ours NAME FILE ... --budget FILE ... --peer NAME FILE ...
        --published FILE SCENE ...

A FILE of --ours and --budget is an error_vs_time.csv. A line joins the ends of trainings with --time_budget, one
--budget for each number of seconds. A FILE of --peer is a peer.csv. That of --published has the columns method, scene,
iteration, seconds and test_psnr.

Several files, or several scenes, give the line of their means: at each iteration that all of them have scored, the
mean seconds and the mean PSNR. A published method that lacks one of the scenes has no line.
"""

import argparse
import csv
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

from splatting.records.error_curve import PEER_REQUIRED, read_peer
from splatting.records.figures import save_figure
from utils.system_utils import UserError, run_cli

OURS, PEERS = ("#0072B2", "#009E73", "#CC79A7"), "0.25"  # Okabe and Ito's colours
LINES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))

Curve = list[tuple[float, float]]  # seconds and dB
Points = dict[int, tuple[float, float]]  # the same by iteration


def read_points(path: str) -> Curve:
    """The points that score all test views."""
    return [(row["seconds"], row["test_psnr"]) for row in read_peer(Path(path))]


def read_line(files: Sequence[str]) -> Curve:
    """The curve of one file, or the mean of several."""
    if not files:
        raise UserError("a line needs a name and at least one file")
    if len(files) == 1:
        return read_points(files[0])
    curves = [read_peer(Path(file), (*PEER_REQUIRED, "iteration")) for file in files]
    return average_curves(
        [{int(row["iteration"]): (row["seconds"], row["test_psnr"]) for row in rows} for rows in curves]
    )


def mean_end(files: Sequence[str]) -> tuple[float, float]:
    """The mean end of the curves."""
    seconds, psnr = zip(*(read_points(file)[-1] for file in files), strict=True)
    return fmean(seconds), fmean(psnr)


def average_curves(curves: Sequence[Points]) -> Curve:
    """Mean seconds and mean PSNR at each iteration that all curves have. UserError if there is none."""
    shared = sorted(set.intersection(*map(set, curves)))
    if not shared:
        raise UserError("the curves of a mean share no iteration; train with the same --test_iterations")
    return [tuple(map(fmean, zip(*(points[at] for points in curves), strict=True))) for at in shared]


def read_published(path: str, scenes: Sequence[str]) -> dict[str, Curve]:
    """The mean curve of each method that has all the scenes."""
    found: dict[str, dict[str, Points]] = defaultdict(lambda: defaultdict(dict))
    try:
        with open(path, encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                point = float(row["seconds"]), float(row["test_psnr"])
                found[row["method"]][row["scene"]][int(row["iteration"])] = point
    except (OSError, KeyError, ValueError) as error:
        raise UserError(f"cannot read {path} as published curves ({error})") from error
    whole = {method: of for method, of in found.items() if of.keys() >= set(scenes)}
    if not scenes or not whole:
        raise UserError(f"{path} has no method with {' and '.join(scenes) or 'no scene: name one'}")
    return {method: average_curves([of[scene] for scene in scenes]) for method, of in whole.items()}


def main() -> None:
    """Draw the lines that the command line names: ours, those of --time_budget, other programs', published ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("png", metavar="PNG", help="the figure to write")
    parser.add_argument("--title", default="", help="above the figure (default: none)")
    add = partial(parser.add_argument, nargs="+")
    add("--ours", action="append", default=[], metavar=("NAME", "FILE"), help="a line of ours")
    add("--budget", action="append", default=[], metavar="FILE", help="trainings with one --time_budget")
    add("--peer", action="append", default=[], metavar=("NAME", "FILE"), help="another's line")
    add("--published", metavar=("FILE", "SCENE"), help="published curves, in pale grey")
    parser.add_argument("--least", type=float, help="lower end of the PSNR shown (default: as the data)")
    args = parser.parse_args()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    axes = figure.subplots()
    if args.published:
        for n, (name, points) in enumerate(read_published(args.published[0], args.published[1:]).items()):
            style = {"color": "0.75", "linestyle": LINES[n % len(LINES)], "linewidth": 1}
            axes.plot(*zip(*points, strict=True), label=f"{name}, published", **style)
    for n, (name, *files) in enumerate(args.peer):
        line = read_line(files)
        style = {"marker": "s"} if len(line) == 1 else {"linestyle": LINES[n % len(LINES)]}
        axes.plot(*zip(*line, strict=True), color=PEERS, label=name, **style)
    for n, (name, *files) in enumerate(args.ours):
        axes.plot(*zip(*read_line(files), strict=True), color=OURS[n % len(OURS)], linewidth=2, label=name)
    if args.budget:
        ends = sorted(mean_end(files) for files in args.budget)
        axes.plot(*zip(*ends, strict=True), color="#D55E00", linewidth=2, marker="o", label="ours, --time_budget")
    axes.set(xscale="log", xlabel="seconds of training", ylabel="PSNR of the test views (dB)", title=args.title)
    axes.set_ylim(bottom=args.least)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(True, which="both", alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=9, loc="lower right")
    save_figure(figure, args.png, 140)


if __name__ == "__main__":
    run_cli(main)
