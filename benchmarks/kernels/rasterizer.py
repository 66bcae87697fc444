"""Run time of the rasterizer on seeded workloads, beside the amount of work, on a CPU or a GPU.

    python -m benchmarks.kernels.rasterizer                  # on the GPU if there is one and the build has CUDA
    python -m benchmarks.kernels.rasterizer --device cpu
    python -m benchmarks.kernels.rasterizer --peers gsplat   # also time another implementation in the same run

Milliseconds are medians. An instance is a splat in a tile. Processed instances are those that the backward reads: in
each tile, those up to the last one that a pixel of the tile blends.
"""

import argparse
from collections.abc import Callable

import torch
from diff_gaussian_rasterization import reference

from benchmarks.harness.calls import Calls, Stages
from benchmarks.harness.environment import describe, print_table
from benchmarks.harness.timing import cpu_milliseconds
from benchmarks.kernels.fragments import TILE, processed_per_tile
from benchmarks.kernels.gpu import measure_on_gpu
from benchmarks.peers.published import WORKLOADS
from benchmarks.workloads.splat_scenes import SplatScene, frustum
from utils.system_utils import UserError, compute_device, run_cli

#                splats  width height median pixel sigma
CPU_WORKLOADS = [(50_000, 400, 400, 2.4), (300_000, 800, 800, 1.7), (5_000, 400, 400, 8.0)]
ORACLE_WORKLOAD = (1_000, 100, 100, 2.4)


def measure(scene: SplatScene, repeats: int) -> dict[str, float]:
    """Measure on the CPU: milliseconds of forward, forward + backward and each stage, and the amount of work."""
    calls, stages = Calls(scene), Stages(scene)
    runs: dict[str, Callable[[], object]] = {"forward": calls.forward, "+ backward": calls.with_backward}
    result = {name: cpu_milliseconds(run, repeats) for name, run in runs.items()}
    with torch.no_grad():
        result |= {name: cpu_milliseconds(run, repeats) for name, run in stages.calls.items()}
    result["instances"] = len(stages.instances)
    result["processed"] = int(processed_per_tile(stages.last).sum())
    return result


def compare_oracle(repeats: int) -> list[str]:
    """Return a row with the oracle's and our milliseconds, forward and with backward, on the small workload."""
    scene = frustum(*ORACLE_WORKLOAD)
    ours = measure(scene, repeats)
    leaves, settings = scene.leaves(torch.float64), scene.settings(torch.float64)
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    named = {name: leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")}

    def forward() -> torch.Tensor:
        return reference.render(leaves["means"], means2d, leaves["opacities"], settings, raw=True, **named).color

    with torch.no_grad():
        alone = cpu_milliseconds(forward, 3)
    both = cpu_milliseconds(lambda: forward().sum().backward(), 3)
    row = [_name(ORACLE_WORKLOAD), f"{alone:.0f} / {both:.0f}"]
    row.append(f"{ours['forward']:.2f} / {ours['+ backward']:.2f}")
    return [*row, f"{alone / ours['forward']:.0f} / {both / ours['+ backward']:.0f}"]


def measure_on_cpu(thread_counts: list[int], repeats: int) -> None:
    """Print times and rates of the stages, then the oracle's times. Evaluations: processed instances x 256 pixels."""
    stages = ["forward", "+ backward", "project", "bin", "blend", "blend_vjp", "project_vjp"]
    header = ["splats, image, sigma", "threads", *stages, "instances", "processed"]
    header += ["G evaluations/s/core forward", "backward"]
    rows = []
    for workload in CPU_WORKLOADS:
        scene = frustum(*workload)
        for threads in dict.fromkeys(thread_counts):
            torch.set_num_threads(threads)
            m = measure(scene, repeats)
            evaluations = m["processed"] * TILE * TILE / threads / 1e6
            row = [_name(workload), str(threads), *(f"{m[stage]:.1f}" for stage in stages)]
            row += [f"{m['instances'] / 1e3:.0f} k", f"{m['processed'] / 1e3:.0f} k"]
            rows.append([*row, f"{evaluations / m['blend']:.2f}", f"{evaluations / m['blend_vjp']:.2f}"])
    print_table(header, rows)
    print()
    oracle_header = ["", "the oracle, ms forward / + backward", "ours, ms", "ratio"]
    print_table(oracle_header, [compare_oracle(repeats)])


def _name(workload: tuple) -> str:
    n, width, height, sigma = workload
    return f"{n // 1000} k, {width}x{height}, {sigma} px"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--device", choices=["cpu", "cuda"], help="default: cuda if there is a GPU and the build has CUDA")
    add("--workloads", nargs="+", choices=list(WORKLOADS), default=list(WORKLOADS), help="GPU: names (default: all)")
    add("--peers", nargs="+", choices=["gsplat"], default=[], help="GPU: other implementations to time as well")
    add("--threads", type=int, nargs="+", default=[1, torch.get_num_threads()], help="CPU: numbers of threads to use")
    add("--repeats", type=int, default=9, help="CPU: number of timed calls (default: 9)")
    args = parser.parse_args()
    found = compute_device().type
    if args.device == "cuda" and found != "cuda":
        raise UserError("--device cuda needs a visible GPU and the rasterizer built with CUDA (GS_CUDA=1)")
    device = args.device or found
    if args.peers and device == "cpu":
        raise UserError("--peers needs --device cuda: the other implementations have no CPU side")
    print(describe(device))
    if device == "cuda":
        measure_on_gpu(args.workloads, args.peers)
    else:
        measure_on_cpu(args.threads, args.repeats)


if __name__ == "__main__":
    run_cli(main)
