"""Milliseconds of a fused training step against the share of the Gaussians that its view sees.

    python -m benchmarks.kernels.seen_share                # 2,000,000 Gaussians on a GPU; kernels' milliseconds
    python -m benchmarks.kernels.seen_share --device cpu   # 50,000; milliseconds by the clock

The scene is a ring of clusters. A step is forward, L1 + D-SSIM, and the backward with Adam and statistics. Dense: every
row takes its step. Lazy: SH coefficients wait until a view may see them (scene/lazy_rows.py), which "catch up" pays
for; "settle" is what all rows cost that then still lack steps. The views of a row see the same share from different
sides, one after the other. Dense and lazy take turns; figures are means over the views, in the better of two rounds.
"""

import argparse
import math
import time
from collections import defaultdict
from collections.abc import Callable

import fused_ssim  # noqa: F401  (registers its operators)
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.ops import scene_arguments
from torch import Tensor

from benchmarks.harness.environment import describe, print_table
from benchmarks.harness.timing import launches
from benchmarks.workloads.ring_of_clusters import ring_of_clusters, view_of_share
from benchmarks.workloads.splat_scenes import PARAMETERS
from utils.system_utils import UserError, compute_device, run_cli

OPS = torch.ops.diff_gaussian_rasterization
SIZES = {"cuda": (2_000_000, 1600, 1060), "cpu": (50_000, 400, 265)}  # Gaussians, width, height
SHARES = [0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0]
_TURN = math.pi * (3 - math.sqrt(5))  # from view to view: they never meet, however many there are
_ROUNDS = 2
_MOST_VIEWS = 120
# Kernels that begin a stage, and those behind which another one begins.
_BEGINS = {
    "catch_up_kernel": "catch up",
    "project_kernel": "project",
    "blend_kernel": "blend",
    "l1_ssim_kernel": "loss",
    "project_vjp_kernel": "step",
}
_NEXT = {"project_kernel": "bin", "l1_ssim_vjp_kernel": "blend_vjp"}
STAGES = ("catch up", "project", "bin", "blend", "loss", "blend_vjp", "step")


class Ring:
    """The scene in training. Learning rates are 0, so that every step meets the same Gaussians."""

    @torch.no_grad()
    def __init__(self, n: int, width: int, height: int, device: str) -> None:
        self.scene = ring_of_clusters(n, width, height, device=device)
        self.values = {name: self.scene.parameters[name] for name in PARAMETERS}
        self.target = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1)).to(device)
        self._averages = [[torch.empty_like(value) for value in self.values.values()] for _ in range(2)]
        self._adam = *self._averages, [torch.zeros(()) for _ in range(6)], [0.0] * 6, 0.9, 0.999, 1e-15, [-1] * 6
        self._statistics = [torch.zeros(n, device=device) for _ in range(3)]
        self._one = torch.ones((), device=device)
        last = torch.empty(n, dtype=torch.int32, device=device)
        self._lazy = {"last_steps": last, "ring": torch.zeros(256, 2, 8, device=device), "taken": last.new_zeros(1)}
        self._number = 0
        self.restart()

    @torch.no_grad()
    def restart(self) -> None:
        """Give Adam's averages their first values; no row waits."""
        for average in (*self._averages[0], *self._averages[1]):
            average.fill_(1e-6)
        self._lazy["last_steps"].fill_(-1)

    def views(self, share: float, count: int) -> list[GaussianRasterizationSettings]:
        """Return views from all sides that see a share of the Gaussians."""
        return [view_of_share(self.scene, share, turn * _TURN) for turn in range(count)]

    @torch.no_grad()
    def step(self, camera: GaussianRasterizationSettings, lazy: bool) -> Tensor:
        """Take the step of a view. Returns the tiles of each Gaussian."""
        scene = scene_arguments(Gaussians(**self.values), camera, True)
        if lazy:
            OPS.catch_up_seen_(*scene, *self._waiting())
            self._number += 1
        out = OPS.rasterize(None, *scene, camera.bg, False, True)
        color, transmittance, _, radii, splats, tiles, *lists, last = out
        _, _, kept = torch.ops.fused_ssim.photometric(color, self.target, 0.2, True)
        gradient = torch.ops.fused_ssim.photometric_vjp(color, self.target, kept, 0.2, self._one)
        state = splats, *lists, camera.bg, last, transmittance, gradient, None, None, tiles, radii
        more = self._lazy | {"number": self._number} if lazy else {}
        OPS.rasterize_vjp_step_(*scene, *state, list(range(6)), *self._adam, False, *self._statistics, **more)
        return tiles

    @torch.no_grad()
    def settle(self) -> None:
        """Let all rows catch up."""
        OPS.catch_up_(self.values["sh_dc"], self.values["sh_rest"], *self._waiting())

    def seen(self, views: list[GaussianRasterizationSettings]) -> float:
        """Return the mean share of the Gaussians that have tiles in a view."""
        return sum(float((self.step(view, False) > 0).double().mean()) for view in views) / len(views)

    def _waiting(self) -> tuple:
        averages = [averages[4:] for averages in self._averages]
        return *averages, [-1, -1], *self._lazy.values()


def milliseconds(ring: Ring, views: list[GaussianRasterizationSettings], lazy: bool) -> dict[str, float]:
    """Return the milliseconds of a step by stage, of all ("total") and of settling; a CPU has only the last two."""

    def run() -> None:
        for view in views:
            ring.step(view, lazy)

    ring.restart()
    run()  # warms up; from now on rows wait as long as they will
    took = {stage: spent / len(views) for stage, spent in _by_stage(run, ring.target.is_cuda).items()}
    return took | ({"settle": _by_stage(ring.settle, ring.target.is_cuda)["total"]} if lazy else {})


def _by_stage(run: Callable[[], None], on_gpu: bool) -> dict[str, float]:
    if not on_gpu:
        start = time.perf_counter()
        run()
        return {"total": 1e3 * (time.perf_counter() - start)}
    took: dict[str, float] = defaultdict(float)
    stage = "project"
    for name, spent in launches(run):
        stage = _BEGINS.get(name, stage)
        took[stage] += spent
        stage = _NEXT.get(name, stage)
    return took | {"total": sum(took.values())}


def measure(device: str, size: tuple[int, int, int], views: int) -> list[list[str]]:
    """Return two rows of the table, dense and lazy, for each share."""
    ring, rows = Ring(*size, device), []
    for share in SHARES:
        cameras = ring.views(share, views)
        seen = ring.seen(cameras)
        turns = [[milliseconds(ring, cameras, lazy) for lazy in (False, True)] for _ in range(_ROUNDS)]
        for name, rounds in zip(("dense", "lazy"), zip(*turns, strict=True), strict=True):
            took = min(rounds, key=lambda stages: stages["total"])
            shown = (*(STAGES if device == "cuda" else ()), "total", "settle")
            rows.append([f"{100 * seen:.1f} %", name, *(f"{took[s]:.3f}" if s in took else "" for s in shown)])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], help="default: cuda if there is a GPU and CUDA kernels")
    parser.add_argument("--views", type=int, default=48, help="of each share, at most 120 (default: 48)")
    args = parser.parse_args()
    found = compute_device().type
    if args.device == "cuda" and found != "cuda":
        raise UserError("--device cuda needs a visible GPU and the rasterizer built with CUDA (GS_CUDA=1)")
    if not 0 < args.views <= _MOST_VIEWS:
        raise UserError(f"--views must be from 1 to {_MOST_VIEWS}, since no row may lack more than 255 steps")
    device = args.device or found
    n, width, height = SIZES[device]
    print(f"{describe(device)}\n{n:,} Gaussians, {width}x{height}, {args.views} views a row, ms a step:")
    header = ["seen", "", *(STAGES if device == "cuda" else ()), "total", "settle"]
    print_table(header, measure(device, SIZES[device], args.views))


if __name__ == "__main__":
    run_cli(main)
