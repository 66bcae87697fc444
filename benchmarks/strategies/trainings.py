"""Trainings of several strategies on several scenes, each seed, on several GPUs or pairs of cores at a time.

    python -m benchmarks.strategies.trainings OUT --scenes SCENE ... --sets benchmarks/strategies/equal.json --gpus 0 1

A file of sets has the options of each by name, like those of `full_eval.py --configs`. An option may be a part of what
the default training "adc" of the same scene took, the mean over the seeds: "50% of gaussians", "33.3% of seconds".
These sets are trained last. Seconds are those of training, and only mean something with one job a GPU. Trainings that
OUT has already are not repeated. OUT/trainings.json has all that the tables of benchmarks.strategies.tables need.
"""

import argparse
import csv
import json
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from tqdm import tqdm

from benchmarks.harness.measuring import describe
from benchmarks.strategies.tables import DEFAULT, print_tables
from utils.system_utils import UserError, atomic_write, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]
_PART = re.compile(r"([0-9.]+)% of (gaussians|seconds)")
_KEPT = ["iteration", "seconds", "gaussians", "test_psnr", "train_psnr", "test_ssim"]


def slots(gpus: list[int], jobs: int, first_core: int, count: int) -> list[dict]:
    """What each of the trainings that run at a time may use: a GPU, or two cores of its own without one."""
    if gpus:
        return [{"CUDA_VISIBLE_DEVICES": str(gpu)} for _ in range(jobs) for gpu in gpus]
    cores = [range(first_core + 2 * index, first_core + 2 * index + 2) for index in range(count)]
    return [{"CUDA_VISIBLE_DEVICES": "", "cores": ",".join(map(str, pair))} for pair in cores]


def command(scene: Path, model: Path, seed: int, options: list[str]) -> list[str]:
    """Blender's scenes have a white background, as in published tables."""
    white = ["-w"] if (scene / "transforms_train.json").exists() else []
    line = [sys.executable, "train.py", "-s", str(scene), "-m", str(model), "--eval", "--seed", str(seed), *white]
    return [*line, "--disable_viewer", "--quiet", *options]


def train(line: list[str], model: Path, slot: dict) -> None:
    """Run a training, unless it has been run. A failure is told and leaves no record."""
    if record(model):
        return
    slot = dict(slot)
    pinned = ["taskset", "-c", slot.pop("cores")] if "cores" in slot else []
    done = subprocess.run([*pinned, *line], cwd=ROOT, env=os.environ | slot, capture_output=True, text=True)
    if done.returncode:
        tqdm.write(f"{model}: status {done.returncode}: {(done.stdout + done.stderr)[-3000:]}", file=sys.stderr)


def record(model: Path) -> dict | None:
    """What tables need of a training that has ended: its last point, those of its curve, the size of its PLY."""
    log = model / "train_log.json"
    if not log.exists() or "iterations_planned" not in json.loads(log.read_text())[-1]:
        return None
    with open(model / "error_vs_time.csv", newline="") as file:
        rows = [
            {key: float(row[key]) for key in _KEPT if row[key]} | {"whole": not row["subset"]}
            for row in csv.DictReader(file)
        ]
    plys = sorted((model / "point_cloud").glob("*/point_cloud.ply"))
    return {"end": rows[-1], "curve": rows, "ply_bytes": plys[-1].stat().st_size}


def means(records: Iterable[dict | None]) -> dict[str, float]:
    """What options may be a part of, from the default trainings of a scene."""
    found = [one["end"] for one in records if one]
    return {key: statistics.mean(end[key] for end in found) for key in ("gaussians", "seconds") if found}


def filled(word: str, known: dict[str, float]) -> str:
    """A word of the options, with the number that it stands for."""
    if not (found := _PART.fullmatch(word)):
        return word
    value = float(found[1]) / 100 * known[found[2]]
    return f"{value:.0f}" if found[2] == "gaussians" else f"{value:.2f}"


def run_all(args: argparse.Namespace, sets: dict[str, list[str]], extra: list[str]) -> dict:
    """Train every set of every scene and seed; the records by scene, set and seed."""
    free: Queue = Queue()
    for slot in slots(args.gpus, args.jobs, args.first_core, args.pairs):
        free.put(slot)
    out = args.out.resolve()
    folder = {
        (scene, name, seed): out / scene.name / name / f"seed{seed}"
        for scene in args.scenes
        for name in sets
        for seed in args.seeds
    }

    def one(scene: Path, name: str, seed: int, known: dict[str, float]) -> None:
        slot = free.get()
        try:
            options = [*(filled(word, known) for word in sets[name]), *extra]
            train(command(scene.resolve(), folder[scene, name, seed], seed, options), folder[scene, name, seed], slot)
        finally:
            free.put(slot)
            bar.update()

    with ThreadPoolExecutor(free.qsize()) as pool, tqdm(total=len(folder), desc="Trainings") as bar:
        later = [name for name in sets if any(map(_PART.fullmatch, sets[name]))]
        for names in ([name for name in sets if name not in later], later):
            tasks = []
            for seed in args.seeds:
                for scene in args.scenes:
                    known = means(record(out / scene.name / DEFAULT / f"seed{seed}") for seed in args.seeds)
                    tasks += [pool.submit(one, scene, name, seed, known) for name in names]
            for task in tasks:
                task.result()
    return {
        scene.name: {name: {str(seed): record(folder[scene, name, seed]) for seed in args.seeds} for name in sets}
        for scene in args.scenes
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("out", type=Path, help="folder for the models and trainings.json")
    add("--scenes", type=Path, nargs="+", required=True, help="COLMAP or Blender scenes")
    add("--sets", type=Path, required=True, help="options of each set by name (JSON)")
    add("--only", nargs="+", help="names of the sets to train (default: all)")
    add("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    add("--gpus", type=int, nargs="*", default=[], help="numbers of the GPUs (default: none, the CPU)")
    add("--jobs", type=int, default=1, help="trainings at a time on each GPU (default: 1)")
    add("--pairs", type=int, default=1, help="without GPUs: trainings at a time, two cores each (default: 1)")
    add("--first_core", type=int, default=0, help="without GPUs: the first core used (default: 0)")
    args, extra = parser.parse_known_args()
    sets = json.loads(args.sets.read_text())
    if args.only:
        if unknown := [name for name in args.only if name not in sets]:
            raise UserError(f"{args.sets} has no set {unknown[0]}; it has {', '.join(sets)}")
        sets = {name: sets[name] for name in args.only}
    found = {
        "machine": describe(compute_device() if args.gpus else "cpu"),
        "sets": sets,
        "options": extra,
        "scenes": run_all(args, sets, extra),
    }
    with atomic_write(args.out / "trainings.json") as path:
        path.write_text(json.dumps(found))
    print_tables(found)


if __name__ == "__main__":
    run_cli(main)
