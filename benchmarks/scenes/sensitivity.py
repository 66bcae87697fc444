"""How much each constant of --strategy budget matters: test PSNR with it halved and doubled, all others unchanged.

    python -m benchmarks.scenes.sensitivity SCENE ... --gpus 0 0 1 1 -- --schedule 8200 --max_num_splats 250000

Words after -- go to train.py. With --schedule, trainings may run beside each other; with --time_budget, one on each
GPU. Differences are between trainings of the same seed: mean and standard error.
"""

import argparse
import contextlib
import importlib
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.harness.measuring import describe, print_table
from benchmarks.harness.trainings import Training, arguments, train_all
from utils.system_utils import run_cli

OPTIONS = (
    *("position_lr_init", "position_lr_final", "feature_lr", "opacity_lr", "scaling_lr", "rotation_lr"),
    *("densification_interval", "densify_from_iter", "densify_until_iter", "prune_opacity", "opacity_decay"),
)
FROM_ONE = ("opacity_decay", "SETTLING")  # whose distance from 1 is halved and doubled
ATTRIBUTES = {
    "MOST_BAND_RATE": "scene.gaussians.density_rules",
    "SQUARES": "splatting.parts.budget",
    "LONGER": "splatting.training.schedule",
    "MOST_RATE": "splatting.training.schedule",
    "SETTLING": "splatting.training.schedule",
    "LEAST_RATE": "splatting.training.schedule",
    "SCORED_VIEWS": "splatting.parts.budget",
    "SH_INTERVAL": "splatting.training.run",
    "AN_ITERATION": "splatting.parts.time_budget_schedule",
}


class Job(NamedTuple):
    """A training: a constant and its factor ("" and 1: none is changed), and the seed."""

    constant: str
    factor: float
    seed: int


def value_of(constant: str) -> float:
    """The value of a constant that no one has changed."""
    from arguments.launch import training_parser

    if constant in OPTIONS:
        return vars(training_parser()[0].parse_args([]))[constant]
    return getattr(importlib.import_module(ATTRIBUTES[constant]), constant)


def changed(constant: str, factor: float) -> float:
    """The value of a constant, or its distance from 1, times a factor; a whole number stays one."""
    value = value_of(constant)
    new = 1 - (1 - value) * factor if constant in FROM_ONE else value * factor
    return max(round(new), 1) if isinstance(value, int) else new


def training_of(job: Job, scene: str, words: Sequence[str]) -> Training:
    """The training of a job. words: of the command line."""
    base = ("-s", scene, "--strategy", "budget", "--seed", str(job.seed), *words)
    if job.constant in OPTIONS:
        return Training((*base, f"--{job.constant}", str(changed(job.constant, job.factor))))
    if not job.constant:
        return Training(base)
    return Training(base, {f"{ATTRIBUTES[job.constant]}:{job.constant}": changed(job.constant, job.factor)})


def table(found: dict[Job, float], constants: Sequence[str], seeds: Sequence[int]) -> list[list[str]]:
    """Rows of a scene's table: a constant, its value, and what halving and doubling it changes. found: test PSNR."""

    def gain(constant: str, factor: float) -> str:
        pairs = [found[Job(constant, factor, seed)] - found[Job("", 1, seed)] for seed in seeds]
        error = f" ± {statistics.stdev(pairs) / len(pairs) ** 0.5:.2f}" if len(pairs) > 1 else ""
        return f"{statistics.mean(pairs):+.2f}{error}"

    rows = [["none changed", "", f"{statistics.mean(found[Job('', 1, seed)] for seed in seeds):.2f} dB", ""]]
    return rows + [[f"`{one}`", f"{value_of(one):g}", gain(one, 0.5), gain(one, 2)] for one in constants]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--constants", nargs="+", default=[*OPTIONS, *ATTRIBUTES], help="default: all")
    args, words = arguments(parser, [0, 1])
    changes = [("", 1.0), *((name, factor) for name in args.constants for factor in (0.5, 2.0))]
    jobs = [Job(*change, seed) for change in changes for seed in args.seeds]
    print(describe("cuda" if args.gpus else "cpu"), flush=True)
    for scene in args.scenes:
        header = ["constant", "value", *(f"{Path(scene).name}: {what}" for what in ("halved", "doubled"))]
        found: dict[Job, float] = {}
        trainings = [training_of(job, scene, words) for job in jobs]
        try:
            with contextlib.closing(train_all(trainings, args.gpus)) as records:
                for job, record in zip(jobs, records, strict=True):
                    found[job] = record["test_psnr"]
        finally:  # an interrupted run keeps what it knows
            known = [one for one in args.constants if {job for job in jobs if job.constant == one} <= found.keys()]
            if known:
                print()
                print_table(header, table(found, known, args.seeds))


if __name__ == "__main__":
    run_cli(main)
