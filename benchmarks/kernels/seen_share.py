"""Milliseconds of a training step against the share of the Gaussians that its view sees, with sleep and without.

    python -m benchmarks.kernels.seen_share                # 2,000,000 Gaussians on a GPU; kernels' milliseconds
    python -m benchmarks.kernels.seen_share --device cpu   # 50,000; milliseconds by the clock

The scene is a ring of clusters, its rows along a Morton curve. A step is forward, loss, and the backward with Adam and
statistics, without sleep and then with it (scene/sleeping.py). The views of a row see the same share from different
sides, one after the other; figures are means over them, in the better of two rounds.
"""

import argparse
import math
import time
from types import SimpleNamespace

import torch

import train
from benchmarks.harness.measuring import add_device, chosen_device, describe, launches, print_table
from benchmarks.workloads.ring_of_clusters import ring_of_clusters, view_of_share
from benchmarks.workloads.splat_scenes import in_morton_order
from gaussian_renderer import draw
from scene.fused_adam import FusedAdam
from scene.gaussian_model import GaussianModel
from scene.sleeping import REST, Sleeping
from utils.loss_utils import photometric_loss
from utils.system_utils import run_cli

SIZES = {"cuda": (2_000_000, 1600, 1060), "cpu": (50_000, 400, 265)}  # Gaussians, width, height
SHARES = [0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0]
_TURN = math.pi * (3 - math.sqrt(5))  # from view to view: they never meet, however many there are
_ROUNDS = 2
_NAMES = {"xyz": "means", "f_dc": "sh_dc", "f_rest": "sh_rest", "opacity": "opacities", "scaling": "scales",
          "rotation": "rotations"}  # fmt: skip


class Ring:
    """The scene in training, with learning rates of 0, so that every step meets the same Gaussians."""

    def __init__(self, n: int, width: int, height: int, device: str) -> None:
        self._scene = in_morton_order(ring_of_clusters(n, width, height, device=device))
        _, _, opt, self._pipe = train.parse(["-s", "."])
        self._gaussians = GaussianModel(3)
        self._gaussians.set_rows({name: self._scene.parameters[ours] for name, ours in _NAMES.items()})
        self._gaussians.active_sh_degree, self._gaussians.spatial_lr_scale = 3, 1.0
        self._gaussians.start_exposures(())
        self._gaussians.training_setup(opt)
        for group in self._gaussians.optimizer.param_groups:
            group["lr"] = 0.0
        self._adam, self._sleeping = FusedAdam(self._gaussians), Sleeping(self._gaussians)
        self._target = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1)).to(device)
        self._background = torch.zeros(3, device=device)

    def views(self, share: float, count: int) -> list[SimpleNamespace]:
        """Return views from all sides that see a share of the Gaussians."""
        return [_camera(view_of_share(self._scene, share, turn * _TURN)) for turn in range(count)]

    def step(self, camera: SimpleNamespace, sleeping: Sleeping | None) -> None:
        """Take the step of a view."""
        drawn = draw(camera, self._gaussians, self._pipe, self._background, sleeping=sleeping)
        image = drawn.image.requires_grad_()
        photometric_loss(image, self._target, 0.2, clamp=False)[0].backward()
        drawn.step(self._adam, image.grad, None, True)
        self.radii = drawn.radii

    def run(self, views: list[SimpleNamespace], sleeps: bool) -> None:
        """Take the steps of all views, and let all blocks rest as trainings do."""
        for taken, view in enumerate(views, 1):
            self.step(view, self._sleeping if sleeps else None)
            if sleeps and taken % REST == 0:
                self._sleeping.rest()

    def milliseconds(self, views: list[SimpleNamespace], sleeps: bool) -> float:
        """Return the milliseconds of a step: on a GPU those of its kernels."""
        self._sleeping.reset()
        self.run(views, sleeps)  # warms up
        if self._target.is_cuda:
            return sum(ms for _, ms in launches(lambda: self.run(views, sleeps))) / len(views)
        start = time.perf_counter()
        self.run(views, sleeps)
        return 1e3 * (time.perf_counter() - start) / len(views)

    def shares(self, views: list[SimpleNamespace]) -> tuple[float, float]:
        """Return the mean share of the Gaussians that a view sees, and of those that are awake."""
        seen, awake = [], []
        self._sleeping.reset()
        for view in views:
            self.step(view, self._sleeping)
            seen.append(float((self.radii > 0).double().mean()))
            awake.append(float(self._sleeping.awake.double().mean()))
        return sum(seen) / len(seen), sum(awake) / len(awake)


def _camera(settings: object) -> SimpleNamespace:
    return SimpleNamespace(
        image_height=settings.image_height,
        image_width=settings.image_width,
        FoVx=2 * math.atan(settings.tanfovx),
        FoVy=2 * math.atan(settings.tanfovy),
        world_view_transform=settings.viewmatrix,
        full_proj_transform=settings.projmatrix,
        camera_center=settings.campos,
    )


def measure(device: str, size: tuple[int, int, int], views: int) -> list[list[str]]:
    """Return a row of the table for each share."""
    ring, rows = Ring(*size, device), []
    for share in SHARES:
        cameras = ring.views(share, views)
        seen, awake = ring.shares(cameras)
        rounds = [[ring.milliseconds(cameras, sleeps) for sleeps in (False, True)] for _ in range(_ROUNDS)]
        without, slept = map(min, zip(*rounds, strict=True))
        rows.append([f"{100 * seen:.1f} %", f"{100 * awake:.1f} %", f"{without:.3f}", f"{slept:.3f}"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_device(parser)
    parser.add_argument("--views", type=int, default=48, help="of each share (default: 48)")
    args = parser.parse_args()
    device = chosen_device(args)
    n, width, height = SIZES[device]
    print(f"{describe(device)}\n{n:,} Gaussians, {width}x{height}, {args.views} views a row, ms a step:")
    print_table(["seen", "awake", "without sleep", "with sleep"], measure(device, SIZES[device], args.views))


if __name__ == "__main__":
    run_cli(main)
