"""Costs of what a training leaves out by itself: the seconds that each omission saves, and the PSNR that it costs.

    python -m benchmarks.scenes.omission SCENE ... --seeds 0 1 2 --gpus 0 1 -- --iterations 7000

Words after -- go to train.py. The first row has the medians of trainings that leave out all that the code does. Each
other row leaves one thing in; its numbers are medians of the differences from the first, by pairs of one seed.
"""

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.measuring import describe_machine, print_table
from benchmarks.harness.trainings import Training, arguments, train_all
from utils.system_utils import run_cli


def _raise_all_bands(run: Any, iteration: int) -> int:
    """Switch on all SH bands at once; stands in for `Run._raises_degree`."""
    return run.gaussians.max_sh_degree if iteration == 1 else 0


NOTHING = "nothing"
OMISSIONS = {  # what is left in, and by which words and changes
    NOTHING: Training(()),
    "rows that sleep": Training((), {"scene.sleeping:MOST_SHARE": 0.0}),
    "SH bands before their turn": Training((), {"splatting.run:Run._raises_degree": _raise_all_bands}),
    "Gaussians unseen at the end": Training(("--keep_unseen",)),
    # With --time_budget alone.
    "large photos of a short training": Training(
        (), {"splatting.features.time_budget_schedule:PYRAMID": ((0.0, 1.0), (0.1, 1.0))}
    ),
}
COLUMNS = {  # heading: key of a record, digits
    "seconds": ("seconds", 2),
    "joules": ("joules", 0),
    "MiB at most": ("peak_memory_mib", 0),
    "MB of the PLY": ("ply_mb", 2),
    "PSNR (dB)": ("test_psnr", 3),
}


def make_rows(names: Sequence[str], records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Rows of the table of one scene: medians, then what leaving one thing in adds to them.

    records: for each seed in turn, of each name, of which the first is NOTHING.
    """
    of = {name: records[place :: len(names)] for place, name in enumerate(names)}
    rows = []
    for name in names:
        cells = []
        for key, digits in COLUMNS.values():
            with_all = [record.get(key) for record in of[NOTHING]]
            values = [record.get(key) for record in of[name]]
            if None in (*with_all, *values):
                cells.append("-")
            elif name == NOTHING:
                cells.append(f"{statistics.median(values):,.{digits}f}")
            else:
                saved = [value - before for value, before in zip(values, with_all, strict=True)]
                cells.append(f"{statistics.median(saved):+,.{digits}f}")
        rows.append([name, *cells])
    return rows


def main() -> None:
    """Train with each omission left in, and print a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--left_in", nargs="+", choices=OMISSIONS, default=list(OMISSIONS), help="default: all")
    args, words = arguments(parser, [0, 1, 2])
    names = list(dict.fromkeys([NOTHING, *args.left_in]))
    left_in = [OMISSIONS[name] for name in names]
    print(describe_machine("cuda" if args.gpus else "cpu"))
    for scene in args.scenes:  # an interrupted run keeps the tables before
        trainings = [
            Training(("-s", scene, "--seed", str(seed), *words, *one.words), one.changes)
            for seed in args.seeds
            for one in left_in
        ]
        records = list(train_all(trainings, args.gpus))
        print(f"\n{Path(scene).name}\n")
        print_table(["left in", *COLUMNS], make_rows(names, records))


if __name__ == "__main__":
    run_cli(main)
