"""Seconds that train.py's process takes beyond its training, beside those of starting torch.

    python -m benchmarks.scenes.process SCENE [--checkouts . OLDER] [--iterations 10 2000] [options of train.py]

The checkouts take turns, each with its own .venv if it has one, and with the line that imports torch and puts a number
on the device. Seconds of training are those of train_log.json, so that the rest has imports, reading, scoring, saving
and drawing. CPU seconds are those of all threads of the process, user and system.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

LINE = "import torch; torch.zeros(1).to({device!r})"
HEADER = ["iterations", "code", "process", "training", "rest", "rest less line", "first iteration less line", "CPU"]


class Process(NamedTuple):
    """What a process took, in seconds. first: from its start to the end of iteration 1, None if its log has no such."""

    wall: float
    cpu: float
    training: float = 0.0
    first: float | None = None


def run(checkout: Path, words: list[str]) -> Process:
    """Run Python in a checkout. UserError if it fails."""
    own = checkout / ".venv" / "bin" / "python"
    start = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(
            [str(own) if own.exists() else sys.executable, *words], cwd=checkout, stdout=said, stderr=said
        )
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        if child.returncode:
            said.seek(0)
            raise UserError(f"{words[0]} in {checkout} ended with status {child.returncode}:\n{said.read().decode()}")
    return Process(wall, used.ru_utime + used.ru_stime)


def train(checkout: Path, scene: Path, iterations: int, options: list[str]) -> Process:
    """Train once into a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["train.py", "-s", str(scene), "-m", folder, "--iterations", str(iterations), *options]
        taken = run(checkout, words)
        last = json.loads(Path(folder, "train_log.json").read_text())[-1]
    return taken._replace(training=last["seconds"], first=last.get("first_iteration_seconds"))


def _shown(values: list[float]) -> str:
    return f"{statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def _row(iterations: int, name: str, runs: list[Process], lines: list[float]) -> list[str]:
    """A row of HEADER; differences from the line are taken within a turn."""
    rest = [run.wall - run.training for run in runs]
    beyond = [seconds - line for seconds, line in zip(rest, lines, strict=True)]
    first = [run.first - line for run, line in zip(runs, lines, strict=True) if run.first is not None]
    columns = [[run.wall for run in runs], [run.training for run in runs], rest, beyond]
    cells = [_shown(values) for values in columns]
    return [str(iterations), name, *cells, _shown(first) if first else "", _shown([run.cpu for run in runs])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("scene", type=Path, help="a scene that train.py takes")
    parser.add_argument("--checkouts", type=Path, nargs="+", default=[Path()], help="folders of the code (default: .)")
    parser.add_argument("--iterations", type=int, nargs="+", default=[10], help="of each training (default: 10)")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each checkout (default: 7)")
    args, options = parser.parse_known_args()
    checkouts, scene = [folder.resolve() for folder in args.checkouts], args.scene.resolve()
    device = compute_device()
    print(describe(device))
    rows = []
    for iterations in args.iterations:
        for folder in checkouts:  # writes byte code and fills the system's caches
            train(folder, scene, iterations, options)
        lines: list[Process] = []
        runs: dict[Path, list[Process]] = {folder: [] for folder in checkouts}
        for _ in range(args.rounds):
            lines.append(run(checkouts[0], ["-c", LINE.format(device=device.type)]))
            for folder in checkouts:
                runs[folder].append(train(folder, scene, iterations, options))
        walls = [line.wall for line in lines]
        rows.append(["", "the line", _shown(walls), "", "", "", "", _shown([line.cpu for line in lines])])
        names = zip(args.checkouts, checkouts, strict=True)
        rows += [_row(iterations, str(name), runs[folder], walls) for name, folder in names]
    print_table(HEADER, rows)


if __name__ == "__main__":
    run_cli(main)
