"""Training of more Gaussians than a GPU with a cap on its memory holds (--spill), beside the same one without the cap.

    python -m benchmarks.parallel.spill --gaussians 20000000 --cap 16
    CUDA_VISIBLE_DEVICES= python -m benchmarks.parallel.spill --gaussians 20000 --size 320 180 --iterations 20

The scene is the city of benchmarks.parallel.steps, with views of a part of its image, so that they see less. Four
trainings, each in a process of its own: as usual and by --spill, both without the cap and with it. A training that does
not fit says so. Digests are of all parameters after the last step. On a CPU there is no cap.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from dataclasses import replace

import torch

from benchmarks.harness.environment import describe, print_table
from benchmarks.parallel.run import WorkloadRun
from benchmarks.parallel.steps import synchronize
from benchmarks.parallel.workload import CITY
from scene.gaussian_model import GaussianModel
from training.loop import run_training
from training.observer import Observer
from training.observers.divergence import DivergenceWatch
from training.step import Step
from utils.host.process import peak_memory_mib
from utils.system_utils import UserError, compute_device, run_cli

_PIECE = 1 << 20  # Gaussians that are copied to the host at a time


class Clock(Observer):
    """Milliseconds of a step, without the first half of the steps."""

    def __init__(self, steps: int) -> None:
        self._half, self._last = steps // 2, steps - 1
        self.milliseconds = 0.0

    def due(self, step: Step) -> bool:
        return False

    def stepped(self, step: Step) -> None:
        if step.iteration in (self._half, self._last):
            synchronize(compute_device())
            now = time.perf_counter()
            if step.iteration == self._last:
                self.milliseconds = 1e3 * (now - self._began) / (self._last - self._half)
            self._began = now


def digest(gaussians: GaussianModel) -> str:
    """The beginning of the SHA-256 of all parameters."""
    found = hashlib.sha256()
    for name in ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"):
        for piece in gaussians.raw(name).detach().split(_PIECE):
            found.update(piece.cpu().numpy().tobytes())
    return found.hexdigest()[:16]


def train(args: argparse.Namespace) -> dict[str, float | str]:
    """Train in this process."""
    device = compute_device()
    if args.cap and device.type == "cuda":
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(args.cap * 2**30 / total, 1.0))
    workload = replace(CITY.changed(args.gaussians, args.size), crop=args.crop)
    run = WorkloadRun(workload, "tiles", args.iterations, still=False, spill=args.spill)
    clock = Clock(args.iterations)
    run.begin()
    run_training(run, [DivergenceWatch(run), clock])
    gib = (peak_memory_mib(device) or 0.0) / 1024
    return {"ms": clock.milliseconds, "gib": gib, "digest": digest(run.gaussians)}


def cells(words: list[str]) -> list[str]:
    """Milliseconds, peak memory and digest of a training in a process of its own."""
    line = [sys.executable, "-m", "benchmarks.parallel.spill", *sys.argv[1:], "--alone", *words]
    done = subprocess.run(line, capture_output=True, text=True)
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1:] or [f"status {done.returncode}"]
        print(f"{' '.join(words)}: {why[0]}", file=sys.stderr)
        return ["-", "-", "does not fit" if "out of memory" in why[0] else "failed"]
    found = json.loads(done.stdout.splitlines()[-1])
    return [f"{found['ms']:.1f}", f"{found['gib']:.2f}", found["digest"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--gaussians", type=int, default=CITY.gaussians, help="default: 20 M")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the image (default: 3840 2160)")
    add("--crop", type=int, default=3, help="views of the middle one in so many parts across and down (default: 3)")
    add("--iterations", type=int, default=60, help="default: 60")
    add("--cap", type=float, default=16.0, help="GiB of the GPU that a capped training may take (default: 16)")
    add("--alone", action="store_true", help=argparse.SUPPRESS)
    add("--spill", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.iterations < 4:
        raise UserError("--iterations takes numbers from 4 on")
    if args.alone:
        print(json.dumps(train(args)))
        return
    print(describe(compute_device()), flush=True)
    free, capped = ["--cap", "0"], ["--cap", f"{args.cap}"]
    rows = [["all on the GPU", "no", *cells(free)], ["--spill", "no", *cells([*free, "--spill"])]]
    if compute_device().type == "cuda":
        limit = f"{args.cap:g} GiB"
        rows += [["--spill", limit, *cells([*capped, "--spill"])], ["all on the GPU", limit, *cells(capped)]]
    print_table(["", "cap", "ms a step", "peak GiB", "parameters"], rows)


if __name__ == "__main__":
    run_cli(main)
