"""Other people's code on ours: a typed-out training loop beside train.py, copies of a camera, and imports.

    python -m benchmarks.scenes.borrowed_loop SCENE [--checkouts . OLDER] [--iterations N]

The checkouts take turns, each with its own .venv if it has one. The loop is benchmarks/scenes/borrowed_program.py. Its
milliseconds are of an iteration after the first 50; those of train.py are of all its iterations, without tests, saves
and loading. Imports are timed after torch's, without garbage collection, which takes 70 ms whenever it happens to run.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

PROGRAM = Path(__file__).with_name("borrowed_program.py")
IMPORTS = """
import gc, time, torch
gc.disable()
start = time.perf_counter()
{statement}
print(1e3 * (time.perf_counter() - start))
"""
STATEMENTS = {
    "import scene": "import scene",
    "import Scene, GaussianModel": "from scene import Scene; from scene.gaussian_model import GaussianModel",
}
ROWS = {
    "train.py, ms an iteration": "train",
    "typed-out loop, ms an iteration": "loop",
    "copy.deepcopy(camera), ms": "deepcopy",
    "pickle.dumps(camera), kB": "pickle",
    "import scene, ms": "import scene",
    "import Scene and GaussianModel, ms": "import Scene, GaussianModel",
}


def measure(checkout: Path, scene: Path, iterations: int) -> dict[str, float]:
    """The numbers of ROWS in one checkout."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["-s", str(scene), "--eval", "--iterations", str(iterations)]
        unscored = ["--no_curve", "--test_iterations", "-1", "--quiet"]
        _run(checkout, ["train.py", *options, "-m", f"{folder}/train", *unscored])
        log = json.loads(Path(folder, "train", "train_log.json").read_text())
        numbers = {"train": 1e3 * log[-1]["seconds"] / iterations}
        done = _run(
            checkout, ["-", str(scene), f"{folder}/loop", str(iterations)], PROGRAM.read_text() + "\n\nmain()\n"
        )
        numbers |= json.loads(done.stderr.splitlines()[-1])
    for name, statement in STATEMENTS.items():
        numbers[name] = float(_run(checkout, ["-c", IMPORTS.format(statement=statement)]).stdout)
    return numbers


def _run(checkout: Path, arguments: list[str], program: str | None = None) -> subprocess.CompletedProcess:
    own = checkout / ".venv" / "bin" / "python"
    python = str(own) if own.exists() else sys.executable
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    done = subprocess.run(
        [python, *arguments], cwd=checkout, env=environment, input=program, capture_output=True, text=True
    )
    if done.returncode:
        raise UserError(f"{arguments[0]} in {checkout} ended with status {done.returncode}:\n{done.stderr[-4000:]}")
    return done


def _shown(values: list[float]) -> str:
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a scene that train.py takes")
    parser.add_argument("--checkouts", type=Path, nargs="+", default=[Path()], help="folders of the code (default: .)")
    parser.add_argument("--iterations", type=int, default=600, help="of each training (default: 600)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each checkout (default: 3)")
    args = parser.parse_args()
    checkouts = [folder.resolve() for folder in args.checkouts]
    print(describe(compute_device()))
    found: dict[Path, dict[str, list[float]]] = {folder: defaultdict(list) for folder in checkouts}
    for _ in range(args.rounds):
        for folder in checkouts:
            for name, value in measure(folder, args.scene.resolve(), args.iterations).items():
                found[folder][name].append(value)
    rows = [[title, *(_shown(numbers[key]) for numbers in found.values())] for title, key in ROWS.items()]
    ratios = [statistics.median([a / b for a, b in zip(f["loop"], f["train"], strict=True)]) for f in found.values()]
    rows.append(["typed-out loop / train.py, median of turns", *(f"{ratio:.2f}" for ratio in ratios)])
    print_table(["", *map(str, args.checkouts)], rows)


if __name__ == "__main__":
    run_cli(main)
