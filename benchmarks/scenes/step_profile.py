"""Profile of the iterations in the middle of a training on a GPU: clock, kernels, host, launches, waits.

    python -m benchmarks.scenes.step_profile SCENE [--checkouts . OLDER] [--first 6400] [options of train.py]

The checkouts take turns, each with its own .venv if it has one, or its own build/device/site. `clock` is without a
profiler, over the iterations before those that are profiled. `host` is the processor's time of the training's thread.
`waits` are calls that wait for the GPU. A second table has the kernels.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.harness.measuring import describe, print_table, short_name
from utils.system_utils import UserError, compute_device, run_cli

PROGRAM = Path(__file__).with_name("step_profile_program.py")
HEADER = ["code", "Gaussians", "clock, us", "kernels, us", "clock / kernels", "host, us", "launches", "waits", "MiB"]
NOT_KERNELS = ("Memcpy HtoD", "Memcpy DtoH")  # they run beside the kernels
SHOWN = 0.005  # of the kernels' time


def profiled(checkout: Path, scene: Path, first: int, count: int, options: list[str]) -> dict:
    """One training of a checkout, up to the end of its profile."""
    own = checkout / ".venv" / "bin" / "python"
    paths = [str(path) for path in (checkout, checkout / "build" / "device" / "site") if path.exists()]
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "profile.json")
        words = [str(own) if own.exists() else sys.executable, "-c", PROGRAM.read_text() + "\n\nmain()\n"]
        words += [str(first), str(count), str(result), "-s", str(scene), "-m", str(Path(folder, "out"))]
        words += ["--test_iterations", "-1", "--no_curve", "--quiet", *options]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        done = subprocess.run(words, cwd=checkout, env=environment, capture_output=True, text=True)
        if not result.exists():
            raise UserError(f"the training in {checkout} ended with status {done.returncode}:\n{done.stderr[-2000:]}")
        return json.loads(result.read_text())


def kernels_of(run: dict) -> float:
    """Microseconds of an iteration's kernels."""
    return sum(us for name, us in run["kernels"].items() if not name.startswith(NOT_KERNELS))


def row(name: str, runs: list[dict]) -> list[str]:
    """A row of HEADER: medians over the runs of a checkout."""
    kernels = median(map(kernels_of, runs))
    clock, host = (1e6 * median(run[key] for run in runs) for key in ("clock", "host"))
    counts = [f"{median(run[key] for run in runs):.1f}" for key in ("launches", "waits")]
    cells = [f"{clock:.0f}", f"{kernels:.0f}", f"{clock / kernels:.2f}", f"{host:.0f}", *counts]
    return [name, f"{runs[0]['gaussians']}", *cells, f"{median(run['memory'] for run in runs) / 2**20:.0f}"]


def by_name(run: dict) -> dict[str, tuple[float, float]]:
    """Microseconds and launches of each short name."""
    sums: dict[str, tuple[float, float]] = {}
    for kernel, us in run["kernels"].items():
        before = sums.get(short_name(kernel), (0.0, 0.0))
        sums[short_name(kernel)] = before[0] + us, before[1] + run["counts"][kernel]
    return sums


def print_kernels(names: list[str], runs: list[dict]) -> None:
    """Microseconds (launches) of an iteration by kernel, for the last run of each checkout."""
    columns = [by_name(run) for run in runs]
    most = {name: max(column.get(name, (0, 0))[0] for column in columns) for column in columns for name in column}
    least = SHOWN * max(map(kernels_of, runs))
    shown = sorted((name for name in most if most[name] >= least), key=lambda name: -most[name])
    rows = [[name, *[_cell([column[name]] if name in column else []) for column in columns]] for name in shown]
    rows.append(
        ["others", *[_cell([sums for name, sums in column.items() if name not in shown]) for column in columns]]
    )
    print_table(["us (launches)", *names], rows)


def _cell(sums: list[tuple[float, float]]) -> str:
    return f"{sum(us for us, _ in sums):.1f} ({sum(count for _, count in sums):.1f})" if sums else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    add = parser.add_argument
    add("scene", type=Path, help="a scene that train.py takes")
    add("--checkouts", type=Path, nargs="+", default=[Path()], help="folders of the code (default: .)")
    add("--first", type=int, default=6200, help="iteration that the clock starts at (default: 6200)")
    add("--count", type=int, default=200, help="iterations by the clock, and profiled (default: 200)")
    add("--rounds", type=int, default=1, help="turns of each checkout (default: 1)")
    args, options = parser.parse_known_args()
    if compute_device().type != "cuda":
        raise UserError("the profile is of a GPU, and none is here")
    print(describe("cuda"))
    runs: list[list[dict]] = [[] for _ in args.checkouts]
    for _ in range(args.rounds):
        for mine, folder in zip(runs, args.checkouts, strict=True):
            mine.append(profiled(folder.resolve(), args.scene.resolve(), args.first, args.count, options))
    names = [str(folder) for folder in args.checkouts]
    print_table(HEADER, [row(name, mine) for name, mine in zip(names, runs, strict=True)])
    print_kernels(names, [mine[-1] for mine in runs])


if __name__ == "__main__":
    run_cli(main)
