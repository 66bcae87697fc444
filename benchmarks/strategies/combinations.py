"""Time budgets with other options beside a plain training of the same seconds.

    python -m benchmarks.strategies.combinations OUT --scenes SCENE ... --cores 0,1

A plain training (adc, steady) is scored every 50 iterations, so that it has a PSNR at any second. Each row is a
training with --time_budget: its iterations, Gaussians and test PSNR, and how much that is above the plain one after as
many seconds. Nothing else may run on these cores. A model that OUT has already is not trained again.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.harness.measuring import describe, print_table
from benchmarks.strategies.trainings import command, train
from utils.system_utils import UserError, run_cli

STEP = 50  # iterations between two scores of the plain training
STRATEGIES = {
    "no strategy named": [],
    "adc": ["--strategy", "adc"],
    "mcmc": ["--strategy", "mcmc"],
    "budget": ["--strategy", "budget"],
}
MIXED = [  # with the second of the seconds
    *("--optimizer_type sparse_adam", "--resolution_schedule none", "--resolution_schedule spectrum", "--antialiasing"),
    *("--random_background", "--spill", "--sh_degree 0", "--plain_step", "--iterations 7000"),
    *("--max_num_splats 15000", "--max_num_splats 100000"),
    *("--strategy adc --absgrad --split long_axis", "--strategy adc --optimizer_type sparse_adam"),
    *("--strategy adc --iterations 7000", "--strategy mcmc --optimizer_type sparse_adam"),
    "--strategy budget --score_error loss --score_join max",
]


def scores(model: Path) -> list[tuple[float, float]]:
    """Seconds and test PSNR of the records of a training; UserError if it failed."""
    try:
        records = json.loads((model / "train_log.json").read_text())
    except OSError as error:
        raise UserError(f"{model} was not trained; see the message above") from error
    return [(one["seconds"], one["test_psnr"]) for one in records if one.get("test_psnr") is not None]


def row(model: Path, plain: Sequence[tuple[float, float]]) -> list[str]:
    last = json.loads((model / "train_log.json").read_text())[-1]
    seconds, psnr = scores(model)[-1]
    other = float(np.interp(seconds, *zip(*plain, strict=True)))
    numbers = f"{last['iteration']:,}", f"{last['gaussians']:,}", f"{psnr:.2f}", f"{psnr - other:+.2f}"
    return [f"{seconds:.1f}", *numbers]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True)
    parser.add_argument("--seconds", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--plain_iterations", type=int, default=2600, help="longer than all seconds (default: 2600)")
    parser.add_argument("--cores", default="0,1", help="for taskset (default: 0,1)")
    args = parser.parse_args()
    runs = [(seconds, name, words) for seconds in args.seconds for name, words in STRATEGIES.items()]
    runs += [(args.seconds[min(1, len(args.seconds) - 1)], mixed, mixed.split()) for mixed in MIXED]
    slot, rows = {"CUDA_VISIBLE_DEVICES": "", "cores": args.cores}, []
    for scene in args.scenes:
        plain, whole = args.out / scene.name / "plain", args.plain_iterations
        times = ["--test_iterations", *map(str, range(STEP, whole, STEP)), str(whole), "--iterations", str(whole)]
        if not plain.exists():
            train(command(scene, plain, 0, [*times, "--no_curve"]), plain, slot)
        for seconds, name, words in tqdm(runs, desc=scene.name):
            model = args.out / scene.name / f"{seconds} {name}".replace(" ", "_")
            if not model.exists():
                last = ["--test_iterations", "7000", "30000", "--no_curve", "--time_budget", str(seconds)]
                train(command(scene, model, 0, [*words, *last]), model, slot)
            rows.append([scene.name, name, *row(model, scores(plain))])
    print(describe(), file=sys.stdout)
    print_table(["scene", "options", "s", "iterations", "Gaussians", "test PSNR", "above plain"], rows)


if __name__ == "__main__":
    run_cli(main)
