"""Time of the rasterizer on seeded workloads, stage by stage, beside the work it did.

    python benchmarks/rasterizer.py

Milliseconds are medians. Processed: instances (a splat in a tile) that the backward has to look at, those behind
which no pixel of the tile is still open left out; evaluations = processed times 256 pixels. The last table has the
oracle (reference.py) on a workload that it can bear.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from diff_gaussian_rasterization import rasterize, reference

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.environment import describe, print_table  # noqa: E402
from benchmarks.splat_scenes import PARAMETERS, SplatScene, frustum  # noqa: E402

#            splats  width height median pixel sigma
WORKLOADS = [(50_000, 400, 400, 2.4), (300_000, 800, 800, 1.7)]
ORACLE_WORKLOAD = (1_000, 100, 100, 2.4)
TILE = 16
OPS = torch.ops.diff_gaussian_rasterization


def milliseconds(run: Callable[[], object], repeats: int) -> float:
    """Median wall time of a call, after one to warm up."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def measure(scene: SplatScene, repeats: int) -> dict[str, float]:
    """Milliseconds of forward, forward + backward and of each stage, and counts."""
    leaves, settings = scene.leaves(torch.float32), scene.settings(torch.float32)
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    gradient = torch.randn(3, scene.height, scene.width, generator=torch.Generator().manual_seed(0))
    named = {name: leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")}

    def forward() -> torch.Tensor:
        return rasterize(leaves["means"], means2d, leaves["opacities"], settings, raw=True, **named).color

    result = {}
    with torch.no_grad():
        result["forward"] = milliseconds(forward, repeats)
    result["+ backward"] = milliseconds(lambda: forward().backward(gradient), repeats)

    with torch.no_grad():
        size = (scene.height, scene.width)
        camera = (settings.viewmatrix, settings.projmatrix, settings.campos, settings.tanfovx, settings.tanfovy)
        inputs = [leaves[name] for name in PARAMETERS]
        arguments = (*inputs[:4], None, None, *inputs[4:], *camera, *size, settings.sh_degree, 1.0, False, True)
        wanted = [True] * 5 + [False] * 2 + [True] * 2
        projected = OPS.project(*arguments)
        binned = OPS.bin(*projected[:4], *size, True)
        instances, slots, ranges, offsets = binned
        splats, counts = projected[0], projected[3]
        blended = OPS.blend(splats, instances, ranges, settings.bg, *size, False, True)
        state = (splats, counts, instances, slots, ranges, offsets, settings.bg, blended[3], blended[1])
        moments = OPS.blend_vjp(*state, gradient, None, None)
        stages = {
            "project": lambda: OPS.project(*arguments),
            "bin": lambda: OPS.bin(*projected[:4], *size, True),
            "blend": lambda: OPS.blend(splats, instances, ranges, settings.bg, *size, False, False),
            "blend_vjp": lambda: OPS.blend_vjp(*state, gradient, None, None),
            "project_vjp": lambda: OPS.project_vjp(*arguments, counts, moments, wanted),
        }
        result |= {name: milliseconds(run, repeats) for name, run in stages.items()}
    result["instances"] = len(instances)
    result["processed"] = processed(blended[3])
    return result


def processed(last: torch.Tensor) -> int:
    """Sum over tiles of the furthest position in the tile's list that any of its pixels blended."""
    height, width = last.shape
    padded = torch.nn.functional.pad(last, (0, -width % TILE, 0, -height % TILE))
    return int(padded.unfold(0, TILE, TILE).unfold(1, TILE, TILE).amax((2, 3)).sum())


def compare_oracle(repeats: int) -> list[str]:
    """A row: the oracle's and our milliseconds, forward and with backward, on the small workload."""
    scene = frustum(*ORACLE_WORKLOAD)
    ours = measure(scene, repeats)
    leaves, settings = scene.leaves(torch.float64), scene.settings(torch.float64)
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    named = {name: leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")}

    def forward() -> torch.Tensor:
        return reference.render(leaves["means"], means2d, leaves["opacities"], settings, raw=True, **named).color

    with torch.no_grad():
        alone = milliseconds(forward, 3)
    both = milliseconds(lambda: forward().sum().backward(), 3)
    row = [_name(ORACLE_WORKLOAD), f"{alone:.0f} / {both:.0f}"]
    row.append(f"{ours['forward']:.2f} / {ours['+ backward']:.2f}")
    return [*row, f"{alone / ours['forward']:.0f} / {both / ours['+ backward']:.0f}"]


def _name(workload: tuple) -> str:
    n, width, height, sigma = workload
    return f"{n // 1000} k, {width}x{height}, {sigma} px"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, torch.get_num_threads()])
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    print(describe())
    stages = ["forward", "+ backward", "project", "bin", "blend", "blend_vjp", "project_vjp"]
    header = ["splats, image, sigma", "threads", *stages, "instances", "processed"]
    header += ["G evaluations/s/core forward", "backward"]
    rows = []
    for workload in WORKLOADS:
        scene = frustum(*workload)
        for threads in dict.fromkeys(args.threads):
            torch.set_num_threads(threads)
            m = measure(scene, args.repeats)
            evaluations = m["processed"] * TILE * TILE / threads / 1e6
            row = [_name(workload), str(threads), *(f"{m[stage]:.1f}" for stage in stages)]
            row += [f"{m['instances'] / 1e3:.0f} k", f"{m['processed'] / 1e3:.0f} k"]
            rows.append([*row, f"{evaluations / m['blend']:.2f}", f"{evaluations / m['blend_vjp']:.2f}"])
    print_table(header, rows)
    print()
    oracle_header = ["", "reference.py, ms forward / + backward", "ours, ms", "ratio"]
    print_table(oracle_header, [compare_oracle(args.repeats)])


if __name__ == "__main__":
    main()
