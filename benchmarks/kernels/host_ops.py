"""Work of the host in a training iteration: operator calls, steps of autograd, and on a GPU launches and waits.

    python -m benchmarks.kernels.host_ops SCENE [options of train.py]

Profiles two trainings of different lengths and subtracts, so that calls made once per training do not count. Operators
called by other operators count too.
"""

import argparse
import sys
import tempfile
from collections import Counter

import torch
from torch.profiler import ProfilerActivity, profile

import train
from benchmarks.harness.environment import describe, print_table
from utils.system_utils import compute_device, run_cli

WARM_UP, COUNTED = 5, 20  # iterations
NODE = "autograd::engine::evaluate_function"
CALLS = ("aten::", "diff_gaussian_rasterization::", "fused_ssim::", NODE, "cuda")


def calls_per_iteration(*options: str) -> dict[str, float]:
    """Count calls by name, most frequent first, in an iteration of `train.py OPTIONS` without densification."""
    longer, shorter = (_calls(WARM_UP + more, options) for more in (COUNTED, 0))
    longer.subtract(shorter)
    return {name: count / COUNTED for name, count in longer.most_common() if count > 0}


def operator_calls(calls: dict[str, float]) -> float:
    """Sum the calls of operators, without autograd's steps and the CUDA runtime."""
    return sum(count for name, count in calls.items() if name != NODE and not name.startswith("cuda"))


def _calls(iterations: int, options: tuple[str, ...]) -> Counter[str]:
    activities = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if torch.cuda.is_available() else [])
    stdout = sys.stdout
    try:
        with tempfile.TemporaryDirectory() as out, profile(activities=activities) as profiled:
            train.main(["-m", out, "--iterations", str(iterations), "--test_iterations", "-1", "--quiet", *options])
    finally:
        sys.stdout = stdout  # training silences it
    names = (NODE if event.name.startswith(NODE) else event.name for event in profiled.events())
    return Counter(name for name in names if name.startswith(CALLS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="folder of the scene; other options go to train.py")
    args, options = parser.parse_known_args()
    calls = calls_per_iteration("-s", args.scene, *options)
    print(f"{describe(compute_device())}\nCalls an iteration, {args.scene}:")
    print_table(["", "calls"], [[name, f"{count:.1f}"] for name, count in calls.items() if count >= 0.5])
    print(f"operators {operator_calls(calls):.0f}, steps of autograd {calls[NODE]:.0f}")


if __name__ == "__main__":
    run_cli(main)
