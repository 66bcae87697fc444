"""Seconds that a user waits for commands around the kernels: rendering to files, scoring, starting a training.

    python -m benchmarks.gate.waiting MODEL --checkout . OLDER

MODEL is a trained model whose scene is there. The commands take turns on all checkouts, which share the installed
extensions; a number is the median of --repeats runs. A run of all commands before them warms the caches of files.
Checkouts must write the same pixels and scores, or the table says which do not.
"""

import argparse
import hashlib
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from arguments import read_cfg_args
from benchmarks.harness.measuring import describe_machine, print_table
from utils.system_utils import UserError, compute_device, run_cli


def _commands(model: Path, scene: str, out: str) -> dict[str, list[str]]:
    """Return the words of each command by its name in the table."""
    return {
        "`import torch` alone": ["-c", "import torch"],
        "`render.py --skip_train`": ["render.py", "-m", str(model), "--skip_train", "--quiet"],
        "`metrics.py`": ["metrics.py", "-m", str(model)],
        "`train.py --iterations 1`": [
            *("train.py", "-s", scene, "-m", out, "--eval", "--iterations", "1", "--disable_viewer", "--quiet"),
        ],
    }


def _seconds(words: list[str], checkout: Path) -> float:
    """Run a command in a checkout and return its seconds. UserError if it fails."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *words], cwd=checkout, capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"{' '.join(words)} failed in {checkout}: {done.stderr.strip().splitlines()[-1:]}")
    return time.perf_counter() - start


def _digest(model: Path) -> str:
    """Return the SHA-256 of what render.py and metrics.py have written: pixels of all PNGs, and the scores."""
    digest = hashlib.sha256((model / "per_view.json").read_bytes())
    for file in sorted((model / "test").rglob("*.png")):
        with Image.open(file) as image:
            digest.update(f"{file.relative_to(model)} {image.size} {image.mode} {image.info}".encode())
            digest.update(image.tobytes())
    return digest.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gate.waiting", description=__doc__.partition("\n")[0])
    parser.add_argument("model", type=Path, metavar="MODEL", help="folder of a trained model")
    parser.add_argument("--checkout", type=Path, nargs="+", default=[Path()], metavar="DIR",
        help="checkouts of the project that take turns (default: this one)")  # fmt: skip
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="runs of each command (default: 3)")
    args = parser.parse_args()
    model = args.model.resolve()
    scene = str(Path(read_cfg_args(model)["source_path"]).resolve())
    checkouts = [checkout.resolve() for checkout in args.checkout]
    with tempfile.TemporaryDirectory() as out:
        commands = _commands(model, scene, out)
        digests, seconds = [], {}
        for checkout in checkouts:
            for words in commands.values():
                _seconds(words, checkout)
            digests.append(_digest(model))
        for _ in range(args.repeats):
            for checkout in checkouts:
                for name, words in commands.items():
                    seconds.setdefault((name, checkout), []).append(_seconds(words, checkout))
    print(f"{describe_machine(compute_device())}; medians of {args.repeats}")
    rows = [[name, *(f"{statistics.median(seconds[name, at]):.1f}" for at in checkouts)] for name in commands]
    print_table(["seconds of", *map(str, args.checkout)], rows)
    print("the same pixels and scores" if len(set(digests)) == 1 else "different pixels or scores")


if __name__ == "__main__":
    run_cli(main)
