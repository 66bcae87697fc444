"""Hashes of trainings, to find machines that give equal bytes: the SHA-256 of five small models, a line of JSON.

    python -m benchmarks.accuracy.hashes --scene SCENE > MACHINE.jsonl
    python -m benchmarks.accuracy.hashes --scene SCENE --compare MACHINE.jsonl OTHER.jsonl > THIS.jsonl

The line is alone on stdout. With --compare a table on stderr has a row for each line, and in each column one letter for
equal bytes; A is the first file's first line. `photos` and `points` are what the trainings read. NumPy draws them with
the instructions of its machine, so copy SCENE to the others. GS_ISA narrows the instruction set of our kernels,
ATEN_CPU_CAPABILITY that of torch, OMP_NUM_THREADS the threads.
"""

import argparse
import hashlib
import json
import shlex
import string
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from applications.demo.make_scene import make_scene
from applications.evaluation.child import run_child
from benchmarks.harness.measuring import add_device, choose_device
from groundwork.host.listing import markdown_table
from groundwork.host.machine import facts
from splatting.records.model_folder import trained_iterations
from splatting.records.renders import model_digest
from utils.system_utils import UserError, run_cli

_ROOT = Path(__file__).resolve().parents[2]
_SCENE = (24, 200, 150, 2000, 0)  # arguments of make_scene
_SHORT = "--disable_viewer --no_curve --quiet --seed 0 --densify_from_iter 50 --densification_interval 50"
TRAININGS = {
    "default": "--iterations 200",
    "budget": "--strategy budget --max_num_splats 4000 --schedule 200",
    "mcmc": "--strategy mcmc --max_num_splats 1900 --iterations 200",
    "antialiasing": "--antialiasing --random_background --iterations 200",
    "ppisp": "--appearance ppisp --iterations 200",
}


def hash_files(paths: Iterable[Path]) -> str:
    """The SHA-256 of the files' bytes, in the order of their paths."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()


def train_and_hash(scene: Path, model: Path, options: str, device: str) -> str:
    """Train a model in a process of its own; the SHA-256 of its last PLY."""
    words = ["-s", str(scene), "-m", str(model), *shlex.split(_SHORT), *shlex.split(options)]
    hidden = {"CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
    done = run_child([sys.executable, str(_ROOT / "train.py"), *words], **hidden)
    if done.status:
        raise UserError(f"train.py {shlex.join(words)} failed with exit status {done.status}")
    digest = model_digest(model, str(trained_iterations(model)[-1]))
    assert digest is not None
    return digest


def measure_machine(device: str, scene: Path | None) -> dict[str, Any]:
    """The facts of this machine, torch's instruction set, and SHA-256 by name. scene: made if it is missing or None."""
    import torch

    with tempfile.TemporaryDirectory() as folder:
        scene = scene or Path(folder) / "scene"
        if not scene.is_dir():
            make_scene(scene, *_SCENE)
        found = {
            "photos": hash_files((scene / "images").iterdir()),
            "points": hash_files((scene / "sparse/0").iterdir()),
        }
        for name, options in TRAININGS.items():
            found[name] = train_and_hash(scene, Path(folder) / name, options, device)
    return facts(device) | {"torch_set": torch.backends.cpu.get_cpu_capability().lower(), "sha256": found}


def make_table(records: Sequence[dict[str, Any]]) -> str:
    """A Markdown table with a row for each record; equal letters in a column are equal bytes."""
    columns = [[record["gpu"] or record["cpu"] for record in records]]
    columns.append(["CUDA" if record["gpu"] else record["instruction_set"] for record in records])
    columns.append([f"{record['packages']['torch']}, {record['torch_set']}" for record in records])
    columns += [[str(record[name]) for record in records] for name in ("threads", "commit")]
    names = ("photos", "points", *TRAININGS)
    for name in names:
        digests = [record["sha256"][name] for record in records]
        letters = dict(zip(dict.fromkeys(digests), string.ascii_uppercase, strict=False))
        columns.append([letters[digest] for digest in digests])
    header = ["machine", "kernels", "torch", "threads", "commit", *names]
    return markdown_table(header, list(zip(*columns, strict=True)), right=False)


def main() -> None:
    """Print this machine's hashes as a line of JSON, and a table beside those of other machines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_device(parser)
    parser.add_argument("--scene", type=Path, help="the demo scene, made if it is missing (default: made anew)")
    parser.add_argument("--compare", type=Path, nargs="+", default=[], metavar="FILE", help="lines of other machines")
    args = parser.parse_args()
    try:
        others = [json.loads(line) for path in args.compare for line in path.read_text(encoding="utf-8").splitlines()]
        make_table(others)  # which reads all that it needs
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(f"--compare found a line that is not of this command: {error!r}") from error
    found = measure_machine(choose_device(args), args.scene)
    print(json.dumps(found, sort_keys=True), flush=True)
    if others:
        print(make_table([*others, found]), file=sys.stderr)


if __name__ == "__main__":
    run_cli(main)
