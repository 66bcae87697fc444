"""Draw test PSNR against seconds of training: ours, other programs on our photos, and published curves.

    python -m benchmarks.peers.figure PNG --title TITLE --ours NAME FILE --budgets FILE ... --peer NAME FILE
        --published FILE SCENE

A FILE of --ours and --budgets is an error_vs_time.csv. --budgets joins the ends of trainings with --time_budget. A FILE
of --peer is a peer.csv. That of --published has the columns method, scene, seconds and test_psnr.
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

from splatting.evaluation.error_curve import read_peer
from utils.system_utils import UserError, atomic_write, run_cli

OURS, PEERS = ("#0072B2", "#009E73", "#CC79A7"), "0.25"  # Okabe and Ito's colours
LINES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))

Curve = list[tuple[float, float]]  # seconds and dB


def curve_of(path: str) -> Curve:
    """The points that score all test views."""
    rows = read_peer(Path(path), ("seconds", "test_psnr"))
    return [(row["seconds"], row["test_psnr"]) for row in rows if row["test_psnr"] is not None]


def published(path: str, scene: str) -> dict[str, Curve]:
    """The curves of each method on a scene."""
    curves: dict[str, Curve] = defaultdict(list)
    try:
        with open(path, encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if row["scene"] == scene:
                    curves[row["method"]].append((float(row["seconds"]), float(row["test_psnr"])))
    except (OSError, KeyError, ValueError) as error:
        raise UserError(f"cannot read {path} as published curves ({error})") from error
    if not curves:
        raise UserError(f"{path} has no scene {scene}")
    return dict(curves)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("png", metavar="PNG", help="the figure to write")
    parser.add_argument("--title", default="", help="above the figure (default: none)")
    parser.add_argument("--ours", nargs=2, action="append", default=[], metavar=("NAME", "FILE"), help="a line of ours")
    parser.add_argument("--budgets", nargs="+", default=[], metavar="FILE", help="trainings with --time_budget")
    parser.add_argument("--peer", nargs=2, action="append", default=[], metavar=("NAME", "FILE"), help="another's line")
    parser.add_argument("--published", nargs=2, metavar=("FILE", "SCENE"), help="published curves, in pale grey")
    parser.add_argument("--least", type=float, help="lower end of the PSNR shown (default: as the data)")
    args = parser.parse_args()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    axes = figure.subplots()
    if args.published:
        for n, (name, points) in enumerate(published(*args.published).items()):
            axes.plot(
                *zip(*points, strict=True), color="0.75", linestyle=LINES[n % len(LINES)], linewidth=1, label=name
            )
    for n, (name, file) in enumerate(args.peer):
        axes.plot(*zip(*curve_of(file), strict=True), color=PEERS, linestyle=LINES[n % len(LINES)], label=name)
    for n, (name, file) in enumerate(args.ours):
        axes.plot(*zip(*curve_of(file), strict=True), color=OURS[n % len(OURS)], linewidth=2, label=name)
    if args.budgets:
        ends = sorted(curve_of(file)[-1] for file in args.budgets)
        axes.plot(*zip(*ends, strict=True), color="#D55E00", linewidth=2, marker="o", label="ours, --time_budget")
    axes.set(xscale="log", xlabel="seconds of training", ylabel="PSNR of the test views (dB)", title=args.title)
    axes.set_ylim(bottom=args.least)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(True, which="both", alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=9, loc="lower right")
    with atomic_write(args.png) as temporary:
        figure.savefig(temporary, dpi=140, metadata={"Software": None})


if __name__ == "__main__":
    run_cli(main)
