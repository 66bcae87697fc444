"""Milliseconds of a fused training step against the share of the Gaussians that its view sees.

    python -m benchmarks.kernels.seen_share                # 2,000,000 Gaussians on a GPU; kernels' milliseconds
    python -m benchmarks.kernels.seen_share --device cpu   # 50,000; milliseconds by the clock

The scene is a ring of clusters. A step is forward, L1 + D-SSIM, and the backward with Adam and statistics. The views of
a row see the same share from different sides, one after the other; figures are means over them, in the better of two
rounds.
"""

import argparse
import math
import time

from diff_gaussian_rasterization import GaussianRasterizationSettings

from benchmarks.harness.calls import STAGES, TrainingStep, by_stage
from benchmarks.harness.environment import add_device, chosen_device, describe, print_table
from benchmarks.harness.timing import launches
from benchmarks.workloads.ring_of_clusters import ring_of_clusters, view_of_share
from utils.system_utils import run_cli

SIZES = {"cuda": (2_000_000, 1600, 1060), "cpu": (50_000, 400, 265)}  # Gaussians, width, height
SHARES = [0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0]
_TURN = math.pi * (3 - math.sqrt(5))  # from view to view: they never meet, however many there are
_ROUNDS = 2


class Ring:
    """The scene in training."""

    def __init__(self, n: int, width: int, height: int, device: str) -> None:
        self.scene = ring_of_clusters(n, width, height, device=device)
        self.step = TrainingStep(self.scene).take

    def views(self, share: float, count: int) -> list[GaussianRasterizationSettings]:
        """Return views from all sides that see a share of the Gaussians."""
        return [view_of_share(self.scene, share, turn * _TURN) for turn in range(count)]

    def seen(self, views: list[GaussianRasterizationSettings]) -> float:
        """Return the mean share of the Gaussians that have tiles in a view."""
        return sum(float((self.step(view) > 0).double().mean()) for view in views) / len(views)


def milliseconds(ring: Ring, views: list[GaussianRasterizationSettings]) -> dict[str, float]:
    """Return the milliseconds of a step by stage, and of all ("total"); a CPU has only the latter."""

    def run() -> None:
        for view in views:
            ring.step(view)

    if not ring.scene.parameters["means"].is_cuda:
        start = time.perf_counter()
        run()
        return {"total": 1e3 * (time.perf_counter() - start) / len(views)}
    took = dict.fromkeys(STAGES, 0.0)
    for stage, _, spent in by_stage(launches(run)):
        took[stage] += spent / len(views)
    return took | {"total": sum(took.values())}


def measure(device: str, size: tuple[int, int, int], views: int) -> list[list[str]]:
    """Return a row of the table for each share."""
    ring, rows = Ring(*size, device), []
    for share in SHARES:
        cameras = ring.views(share, views)
        seen = ring.seen(cameras)  # warms up
        took = min((milliseconds(ring, cameras) for _ in range(_ROUNDS)), key=lambda stages: stages["total"])
        rows.append([f"{100 * seen:.1f} %", *(f"{took[s]:.3f}" for s in (*STAGES, "total") if s in took)])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_device(parser)
    parser.add_argument("--views", type=int, default=48, help="of each share (default: 48)")
    args = parser.parse_args()
    device = chosen_device(args)
    n, width, height = SIZES[device]
    print(f"{describe(device)}\n{n:,} Gaussians, {width}x{height}, {args.views} views a row, ms a step:")
    print_table(["seen", *(STAGES if device == "cuda" else ()), "total"], measure(device, SIZES[device], args.views))


if __name__ == "__main__":
    run_cli(main)
