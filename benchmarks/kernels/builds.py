"""Milliseconds of the rasterizer's calls in two builds by turns, on the CPU or a GPU.

    python -m benchmarks.kernels.builds OLD NEW     # folders that hold an installed diff_gaussian_rasterization each
    python -m benchmarks.kernels.builds OLD NEW --device cpu

Each build has a process of its own, and only one works at a time. A turn is the median of several calls, each on an
idle device, host included. Figures are medians over the turns, the ratio that of the two builds' turns side by side.
Processes are started several times, as the place of their memory alone changes a call. They keep the memory that they
free: giving it back to the system, and asking again, took up to a tenth of a call in some processes of either build.
"""

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from benchmarks.harness.measuring import (
    add_device,
    chosen_device,
    cpu_milliseconds,
    describe,
    gpu_milliseconds,
    print_table,
)
from benchmarks.workloads.splat_scenes import CPU_WORKLOADS, GPU_WORKLOADS, frustum
from utils.system_utils import UserError, run_cli

TINY = {"XS": (20, 32, 32, 2.4)}  # the host's part of a call, and little else
NAMES = ("XS", "S", "M", "L")
CPU_CALLS = {"XS": 300, "S": 40, "M": 10, "L": 3}  # of a turn
GPU_CALLS, WARM_UPS = 40, 5
KEEP_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**34), "MALLOC_MMAP_MAX_": "0"}  # of glibc
STEPS = ("forward", "+ backward", "step")


class Build:
    """A process with the rasterizer of one folder, which times calls when it is asked to."""

    def __init__(self, folder: str, device: str) -> None:
        path = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
        self._folder = folder
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.kernels.builds", folder, folder, "--device", device, "--serve"],
            env={**os.environ, **KEEP_MEMORY, "PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def milliseconds(self, workload: str, step: str) -> float:
        """The median time of a turn of calls."""
        with suppress(BrokenPipeError):
            self._process.stdin.write(f"{workload},{step}\n")
            self._process.stdin.flush()
            if answer := self._process.stdout.readline():
                return float(answer)
        raise UserError(f"the rasterizer of {self._folder} failed: see above")

    def end(self) -> None:
        self._process.stdin.close()
        self._process.wait()


def serve(device: str) -> None:
    """Answer each line "workload,step" with milliseconds."""
    from benchmarks.harness.calls import Calls  # the build that this process got

    made: dict[str, dict[str, Callable[[], object]]] = {}
    for line in sys.stdin:
        workload, step = line.strip().split(",")
        if workload not in made:
            sizes = TINY | (GPU_WORKLOADS if device == "cuda" else CPU_WORKLOADS)
            made[workload] = Calls(frustum(*sizes[workload], device=device)).steps()
        run = made[workload][step]
        gpu = device == "cuda"
        took = gpu_milliseconds(run, WARM_UPS, GPU_CALLS) if gpu else cpu_milliseconds(run, CPU_CALLS[workload])
        print(took, flush=True)


def measure(args: argparse.Namespace, device: str, workload: str) -> list[dict[str, list[float]]]:
    """Turns of new processes: milliseconds of each step by both builds."""
    builds = [Build(folder, device) for folder in (args.old, args.new)]
    turns = [
        {step: [build.milliseconds(workload, step) for build in builds] for step in STEPS}
        for _ in range(1 + args.rounds)
    ]
    for build in builds:
        build.end()
    return turns[1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("old", help="folder with a diff_gaussian_rasterization, as pip install --target makes it")
    add("new", help="another one")
    add_device(parser)
    add("--workloads", nargs="+", choices=NAMES, default=list(NAMES), help="default: all")
    add("--starts", type=int, default=5, help="of each build's process (default: 5)")
    add("--rounds", type=int, default=5, help="turns of each of them (default: 5)")
    add("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    device = chosen_device(args)
    if args.serve:
        serve(device)
        return
    for folder in (args.old, args.new):
        if not (Path(folder) / "diff_gaussian_rasterization").is_dir():
            raise UserError(f"{folder} holds no diff_gaussian_rasterization: install one with pip install --target")
    print(describe(device))
    rows = []
    for workload in args.workloads:
        turns = [turn for _ in range(args.starts) for turn in measure(args, device, workload)]
        for step in STEPS:
            old, new = (statistics.median(turn[step][build] for turn in turns) for build in range(2))
            ratio = statistics.median(turn[step][1] / turn[step][0] for turn in turns)
            rows.append([workload, step, f"{old:.3f}", f"{new:.3f}", f"{ratio:.3f}"])
    print_table(["workload", "ms", args.old, args.new, "new / old"], rows)


if __name__ == "__main__":
    run_cli(main)
