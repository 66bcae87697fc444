"""Steps of training by several numbers of processes of one host, by turns, and the ratio to one process.

    python -m benchmarks.parallel.table --ranks 2

It starts `benchmarks.parallel.steps` once for each number, 1 among them, in each round, and takes for each measurement
the best round; what a part of a step takes is that round's. Options that it does not know go to that command.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.harness.environment import describe, print_table
from benchmarks.parallel.steps import SUMMARY, milliseconds, stage_rows, summary
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]
_MODULE = "benchmarks.parallel.steps"


def command(count: int, options: list[str]) -> list[str]:
    """The command line of a measurement by so many processes."""
    start = [sys.executable, "-m"]
    if count > 1:
        start += ["torch.distributed.run", "--standalone", f"--nproc_per_node={count}", "-m"]
    return [*start, _MODULE, *options]


def measure(count: int, options: list[str], limit: float) -> dict[str, Any] | None:
    """The numbers of a run, None if it fails or takes longer than `limit` seconds, which is said on stderr."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.json"
        line = command(count, [*options, "--json", str(path)])
        with subprocess.Popen(line, cwd=ROOT, stdout=sys.stderr) as process:
            try:
                process.wait(limit)
            except subprocess.TimeoutExpired:
                process.terminate()
                _wait_or_kill(process)
        if process.returncode or not path.exists():
            print(f"{count} processes: no result (status {process.returncode})", file=sys.stderr)
            return None
        return json.loads(path.read_text(encoding="utf-8"))


def _wait_or_kill(process: subprocess.Popen) -> None:
    """torchrun ends its ranks, and kills them if they do not end."""
    try:
        process.wait(45)
    except subprocess.TimeoutExpired:
        process.kill()


def best(rounds: list[dict[str, Any]]) -> list[tuple[dict[str, Any], float]]:
    """Each measurement of the runs of one number of processes, from the round where it was fastest, and its links."""
    places = range(len(rounds[0]["results"]))
    return [
        min(((found["results"][place], found["link"]) for found in rounds), key=lambda one: milliseconds(one[0]))
        for place in places
    ]


def ratios(found: list[tuple[dict[str, Any], float]]) -> list[list[str]]:
    """Rows of the table: `summary`, and images a second as a multiple of those of one process."""
    alone = {one["workload"]: milliseconds(one) for one, _ in found if one["ranks"] == 1}
    rows = []
    for one, link in sorted(found, key=lambda each: (each[0]["workload"], each[0]["ranks"])):
        base = alone.get(one["workload"])
        rows.append([*summary(one, link), f"{one['views'] * base / milliseconds(one):.2f}" if base else "-"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ranks", type=int, nargs="+", default=[2], help="besides one process (default: 2)")
    parser.add_argument("--rounds", type=int, default=2, help="default: 2")
    parser.add_argument("--limit", type=float, default=150.0, help="seconds of a run (default: 150)")
    args, options = parser.parse_known_args()
    counts = sorted({1, *args.ranks})
    if counts[0] < 1 or args.rounds < 1:
        raise UserError("--ranks and --rounds take numbers from 1 on")
    print(describe(compute_device()), flush=True)
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in counts}
    for _ in range(args.rounds):
        for count in counts:
            if found := measure(count, options, args.limit):
                runs[count].append(found)
    kept = [one for found in runs.values() if found for one in best(found)]
    if not kept:
        raise UserError("no run had a result; see what each has said")
    print_table([*SUMMARY, "times one process"], ratios(kept))
    for one, _ in kept:
        print(f"\n{one['workload']}, {one['ranks']} ranks, {one['parallel']}:")
        print_table(["stage", "ms", "over ranks", "MiB sent"], stage_rows(one))


if __name__ == "__main__":
    run_cli(main)
