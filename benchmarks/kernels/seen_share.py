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
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

import train
from benchmarks.harness.measuring import add_device, chosen_device, describe, launches, print_table
from benchmarks.workloads.splat_scenes import FOV, Draw, SplatScene, in_morton_order, model_rows, on_device, settings
from gaussian_renderer import draw
from scene.cameras import ZFAR, ZNEAR, MiniCam
from scene.fused_adam import FusedAdam
from scene.gaussian_model import GaussianModel
from scene.sleeping import REST, Sleeping
from utils.loss_utils import photometric_loss
from utils.system_utils import run_cli

SIZES = {"cuda": (2_000_000, 1600, 1060), "cpu": (50_000, 400, 265)}  # Gaussians, width, height
SHARES = [0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0]
_TURN = math.pi * (3 - math.sqrt(5))  # from view to view: they never meet, however many there are
_ROUNDS = 2
_PLENTY = [2**26, 2**28, 2**26, 2**20]  # instances, slots, gradient rows, blocks
# The scene: a ring of clusters, and cameras that see a requested share of it.
_RADIUS = 10.0
_CLUSTERS = 60
_SIGMA_PX = 1.4  # median size from the ring's middle
_FARTHEST = 4 * _RADIUS  # from where a view has the whole ring in front of it
_HALVINGS = 40  # of the bisection


def ring_of_clusters(n: int, width: int, height: int, device: str) -> SplatScene:
    """Draw Gaussians in clusters that stand in a ring around the origin, in the plane of x and z; rows at random."""
    numbers = Draw(0, device)
    cluster = (_CLUSTERS * numbers.uniform(n)).long().clamp_max(_CLUSTERS - 1)
    angles = 2 * math.pi * (torch.arange(_CLUSTERS, device=device) + numbers.uniform(_CLUSTERS)) / _CLUSTERS
    centers = torch.stack([_RADIUS * angles.sin(), 4 * numbers.uniform(_CLUSTERS) - 2, _RADIUS * angles.cos()], -1)
    size = math.log(_SIGMA_PX * _RADIUS / (width / (2 * math.tan(FOV / 2)))) + 0.8 * numbers.normal(n)
    return SplatScene(
        {"means": centers[cluster] + 0.5 * numbers.normal(n, 3)} | numbers.appearance(size), width, height
    )


def view_of_share(scene: SplatScene, share: float, turn: float) -> GaussianRasterizationSettings:
    """Return a camera that looks away from the ring's axis, `turn` radians from +z, and sees a share of the means.

    A camera that moves backwards along its axis sees more and more, from a few Gaussians behind the ring on its far
    side to all of them.
    """
    means = scene.parameters["means"][:: max(1, len(scene.parameters["means"]) // 100_000)].double()
    nearest, farthest = -1.2 * _RADIUS, _FARTHEST
    for _ in range(_HALVINGS):
        back = (nearest + farthest) / 2
        seen = _share_of(means, scene, _view(turn, back))
        nearest, farthest = (back, farthest) if seen < share else (nearest, back)
    camera = settings(scene.width, scene.height, torch.float32, view=_view(turn, farthest))
    return on_device(camera, scene.parameters["means"].device)


def _view(turn: float, back: float) -> Tensor:
    """World to view, of a camera that stands `back` behind the origin."""
    view = torch.eye(4, dtype=torch.float64)
    sine, cosine = math.sin(turn), math.cos(turn)
    view[0, 0], view[0, 2], view[2, 0], view[2, 2] = cosine, -sine, sine, cosine
    view[2, 3] = back
    return view


def _share_of(means: Tensor, scene: SplatScene, view: Tensor) -> float:
    """The share of the means that lie on the image."""
    view = view.to(means.device)
    x, y, z = (means @ view[:3, :3].T + view[:3, 3]).T
    wide = math.tan(FOV / 2)
    high = wide * scene.height / scene.width
    return float(((z > 0.2) & (x.abs() < wide * z) & (y.abs() < high * z)).double().mean())


class Ring:
    """The scene in training, with learning rates of 0, so that every step meets the same Gaussians."""

    def __init__(self, n: int, width: int, height: int, device: str) -> None:
        self._scene = in_morton_order(ring_of_clusters(n, width, height, device))
        _, _, opt, self._pipe = train.parse(["-s", "."])
        self._gaussians = GaussianModel(3)
        self._gaussians.set_rows(model_rows(self._scene.parameters))
        self._gaussians.active_sh_degree, self._gaussians.spatial_lr_scale = 3, 1.0
        self._gaussians.start_exposures(())
        self._gaussians.training_setup(opt)
        for group in self._gaussians.optimizer.param_groups:
            group["lr"] = 0.0
        self._adam, self._sleeping = FusedAdam(self._gaussians), Sleeping(self._gaussians)
        self._target = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1)).to(device)
        self._background = torch.zeros(3, device=device)
        self._needed: dict[MiniCam, list[int]] = {}
        self._words = torch.zeros(6, dtype=torch.int64, device=device)  # of run_ahead_

    def views(self, share: float, count: int) -> list[MiniCam]:
        """Return views from all sides that see a share of the Gaussians."""
        return [_camera(view_of_share(self._scene, share, turn * _TURN)) for turn in range(count)]

    def step(self, camera: MiniCam, sleeping: Sleeping | None) -> None:
        """Take the step of a view."""
        with self._ahead(camera):
            drawn = draw(camera, self._gaussians, self._pipe, self._background, sleeping=sleeping)
            image = drawn.image.requires_grad_()
            photometric_loss(image, self._target, 0.2, clamp=False)[0].backward()
            drawn.step(self._adam, image.grad, None, True)
        self.radii = drawn.radii

    @contextmanager
    def _ahead(self, camera: MiniCam) -> Iterator[None]:
        """Within it, a GPU is given the capacity that a view needs, as in a training, after it was waited for once."""
        if not self._target.is_cuda:
            yield
            return
        known = self._needed.get(camera)
        OPERATORS.run_ahead_(self._words, known or _PLENTY, None)
        try:
            yield
        finally:
            OPERATORS.run_ahead_(None, [], None)
        if known is None:
            halted, *needed, _ = self._words.tolist()
            assert not halted
            self._needed[camera] = [5 * number // 4 + 16 for number in needed]

    def run(self, views: list[MiniCam], sleeps: bool) -> None:
        """Take the steps of all views, and let all blocks rest as trainings do."""
        for taken, view in enumerate(views, 1):
            self.step(view, self._sleeping if sleeps else None)
            if sleeps and taken % REST == 0:
                self._sleeping.rest()

    def milliseconds(self, views: list[MiniCam], sleeps: bool) -> float:
        """Return the milliseconds of a step: on a GPU those of its kernels."""
        self._sleeping.reset()
        self.run(views, sleeps)  # warms up
        if self._target.is_cuda:
            total = sum(ms for _, ms in launches(lambda: self.run(views, sleeps)))
            assert not self._words[0], "a step halted"
            return total / len(views)
        start = time.perf_counter()
        self.run(views, sleeps)
        return 1e3 * (time.perf_counter() - start) / len(views)

    def shares(self, views: list[MiniCam]) -> tuple[float, float]:
        """Return the mean share of the Gaussians that a view sees, and of those that are awake."""
        seen, awake = [], []
        self._sleeping.reset()
        for view in views:
            self.step(view, self._sleeping)
            seen.append(float((self.radii > 0).double().sum()) / len(self._gaussians))
            awake.append(float(self._sleeping.awake.double().mean()))
        return sum(seen) / len(seen), sum(awake) / len(awake)


def _camera(settings: GaussianRasterizationSettings) -> MiniCam:
    angles = (2 * math.atan(tangent) for tangent in (settings.tanfovy, settings.tanfovx))
    matrices = settings.viewmatrix, settings.projmatrix
    return MiniCam(settings.image_width, settings.image_height, *angles, ZNEAR, ZFAR, *matrices)


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
