"""Kernels of a forward and backward where some tiles have long lists, as in renders of an object, and where none has.

    python -m benchmarks.kernels.long_lists                # 200 k splats in the middle of 400x400 pixels, and S
    python -m benchmarks.kernels.long_lists --repeats 5    # shows how far the times scatter

Milliseconds are means over ten calls. Needs a GPU. On a CPU it prints the amount of work alone.
"""

import argparse

import torch

from benchmarks.harness.calls import Calls, Stages
from benchmarks.harness.environment import describe, print_table
from benchmarks.harness.timing import GpuTime, gpu_time, peak_mib
from benchmarks.kernels.fragments import processed_per_tile
from benchmarks.peers.published import WORKLOADS
from benchmarks.workloads.splat_scenes import SplatScene, frustum, heap
from utils.system_utils import compute_device, run_cli


def count_work(scene: SplatScene) -> list[str]:
    """Return tiles with a list, instances, the longest list, processed instances, and the most of them in a tile."""
    stages = Stages(scene)
    lengths, processed = stages.ranges.diff(), processed_per_tile(stages.last)
    counts = (lengths > 0).sum(), lengths.sum(), lengths.max(), processed.sum(), processed.max()
    return [f"{int(count):,}" for count in counts]


def kernel_rows(times: list[GpuTime]) -> list[list[str]]:
    """Return a row for each kernel, with its time in each measurement, and one with their sums."""
    names = [kernel.name for kernel in times[0].launched]
    assert all([kernel.name for kernel in time.launched] == names for time in times), "calls differ in their kernels"
    rows = [[name, *(f"{time.launched[i].milliseconds:.4f}" for time in times)] for i, name in enumerate(names)]
    return [*rows, ["sum", *(f"{time.kernels:.4f}" for time in times)]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each workload (default: 3)")
    args = parser.parse_args()
    device = compute_device()
    print(describe(device.type))
    for name, scene in {"heap": heap(device=device), "S": frustum(*WORKLOADS["S"], device=device)}.items():
        print(f"\n{name}: {len(scene.parameters['means']):,} splats, {scene.width}x{scene.height}")
        header = ["tiles with a list", "instances", "longest list", "processed", "most in a tile"]
        print_table(header, [count_work(scene)])
        if device.type != "cuda":
            continue
        calls = Calls(scene)
        peaks = [peak_mib(run, calls.clear) for run in (calls.forward, calls.with_backward)]
        print("peak above the inputs, MiB: forward {:.1f}, + backward {:.1f}".format(*peaks))
        times = [gpu_time(calls.with_backward) for _ in range(args.repeats)]
        print_table(["kernel", *("ms" for _ in times)], kernel_rows(times))
        calls.clear()
        torch.cuda.empty_cache()


if __name__ == "__main__":
    run_cli(main)
