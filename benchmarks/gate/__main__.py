"""Gate before a release: is this code worse, or slower, than the stored baseline?

    python -m benchmarks.gate            # exit status 1 and a table if it is
    python -m benchmarks.gate --write    # store the numbers of this commit

Three scenes with two seeds are trained and scored. PSNR, SSIM, the number of Gaussians and the bytes of the PLY may be
worse than the stored means by three standard deviations over the stored seeds. Seconds are compared with those of the
stored commit, which is built here and takes turns with this code: this, stored, stored, this. The least of each counts,
and the ratio may be 1.10. If it is more, both take more turns, at most six each, as machines are slow at times.
"""

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from benchmarks.gate.baseline import (
    FILE,
    HEADER,
    MOST_TIME,
    QUANTITIES,
    Row,
    judge_quality,
    judge_time,
    machine_kind,
    read_baseline,
    write_baseline,
)
from benchmarks.gate.trainings import Build, Task, build_older, list_tasks, read_head, train_and_score, train_and_time
from benchmarks.harness.measuring import describe_machine, print_table
from utils.system_utils import compute_device, run_cli

SEEDS, STORED_SEEDS = (0, 1), (0, 1, 2, 3, 4)
MOST_TURNS = 6  # of this code, and of the stored build
ITERATIONS = {"cpu": 1000, "cuda": 7000}  # some seconds of training, beside which noise is small


def store(path: Path, kind: str, work: dict[str, Task], iterations: int) -> None:
    """Train every scene with the stored seeds and write the baseline of this kind of machine."""
    commit = read_head()
    scenes: dict[str, list[dict[str, float]]] = {name: [] for name in work}
    with tqdm(total=len(work) * len(STORED_SEEDS), desc="Training", unit="run") as bar:
        for name, task in work.items():
            for seed in STORED_SEEDS:
                found = train_and_score(task, seed)
                scenes[name].append({key: found[key] for key in ("seed", *(q.name for q in QUANTITIES))})
                bar.update()
    write_baseline(path, kind, {"commit": commit, "iterations": iterations, "scenes": scenes})


def compare(stored: dict[str, list[dict]], work: dict[str, Task], build: Build) -> list[Row]:
    """Train every scene by this code and by the stored build, in turns; return the judgement."""
    rows = []
    with tqdm(total=4 * len(work) * len(SEEDS), desc="Training", unit="run") as bar:
        for name, task in work.items():
            found, pairs = [], []
            for seed in SEEDS:
                found.append(train_and_score(task, seed))
                bar.update()
                pairs.append(best_times(task, seed, build, found[-1]["seconds"], bar))
            rows += [*judge_quality(name, stored[name], found), judge_time(name, pairs)]
    return rows


def best_times(task: Task, seed: int, build: Build, first: float, bar: tqdm) -> tuple[float, float]:
    """Return the least seconds of this code and of the stored build. first: those of a training by this code."""
    now, before = [first], []
    turns = [build, build, None]
    while turns:
        for turn in turns:
            (now if turn is None else before).append(train_and_time(task, seed, turn))
            bar.update()
        slower = min(now) > MOST_TIME * min(before)
        turns = [build, None] if slower and len(now) < MOST_TURNS else []
        bar.total += len(turns)
    return min(now), min(before)


def main() -> None:
    """Run the command line. Exit status 1 if something is worse."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("--write", action="store_true", help="store the numbers of this commit instead of comparing")
    parser.add_argument("--baseline", type=Path, default=FILE, help="stored numbers (default: benchmarks/gate.json)")
    parser.add_argument("--iterations", type=int, help="of each training (default: 1000, on a GPU 7000)")
    args = parser.parse_args()
    device = compute_device()
    iterations = ITERATIONS[device.type] if args.iterations is None else args.iterations
    kind, work = machine_kind(), list_tasks(iterations)
    print(describe_machine(device), flush=True)
    if args.write:
        store(args.baseline, kind, work, iterations)
        return
    record = read_baseline(args.baseline, kind, list(work), iterations)
    rows = compare(record["scenes"], work, build_older(record["commit"]))
    print_table(HEADER, [row.cells() for row in rows])
    worse = [row for row in rows if not row.passed]
    print(f"{len(worse)} of {len(rows)} are worse than at {record['commit'][:7]}" if worse else "the gate is passed")
    if worse:
        sys.exit(1)


if __name__ == "__main__":
    run_cli(main)
