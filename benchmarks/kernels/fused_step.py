"""A backward with Adam's step and density control's statistics: as operators one after the other, and fused into one.

    python -m benchmarks.kernels.fused_step                  # on the GPU if there is one and the build has CUDA
    python -m benchmarks.kernels.fused_step --device cpu

The two take turns. Milliseconds are medians, without blend_vjp, which both have: on the CPU it finds no instances, and
on a GPU its kernels are left out. Peaks are MiB above the inputs.

On a GPU a second table has the whole step, forward to statistics: calls from an idle GPU, with the host in them, and
the sum of their kernels.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import fused_ssim  # noqa: F401  (registers its operators)
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.ops import scene_arguments
from diff_gaussian_rasterization.schema import GRADIENTS
from torch import Tensor

from benchmarks.harness.environment import describe, print_table
from benchmarks.harness.timing import gpu_time, peak_mib
from benchmarks.kernels.rasterizer import CPU_WORKLOADS
from benchmarks.peers.published import WORKLOADS
from benchmarks.workloads.splat_scenes import PARAMETERS, frustum
from utils.system_utils import UserError, compute_device, run_cli

OPS = torch.ops.diff_gaussian_rasterization


class Steps:
    """The calls that follow a loss, on one forward. Learning rates are 0, so that every call meets the same values."""

    @torch.no_grad()
    def __init__(self, values: dict[str, Tensor], camera: GaussianRasterizationSettings, blended: bool) -> None:
        self.values = {name: values[name].detach().float().clone() for name in PARAMETERS}
        scene = scene_arguments(Gaussians(**self.values), camera, True)
        out = OPS.rasterize(None, *scene, camera.bg, False, True)
        color, transmittance, _, self.radii, splats, counts, instances, ranges, splat_slots, slots, last, layers = out
        generator = torch.Generator().manual_seed(0)
        gradient = torch.randn(color.shape, generator=generator).to(color)
        self.camera, self.scene, self.target, self.one = camera, scene, torch.rand_like(color), color.new_ones(())
        if not blended:
            instances, slots = instances[:0], slots[:0]
            for positions in (ranges, splat_slots, last):
                positions.zero_()
        lists = instances, ranges, splat_slots, slots
        self.backward = *scene, splats, *lists, camera.bg, last, transmittance, gradient, None, None, counts, layers
        averages = [[torch.full_like(value, 1e-6) for value in self.values.values()] for _ in range(2)]
        self.adam = *averages, [torch.zeros(()) for _ in range(6)], [0.0] * 6, 0.9, 0.999, 1e-15, [-1] * 6
        self.statistics = [torch.zeros(len(self.radii), device=color.device) for _ in range(3)]

    def in_parts(self) -> None:
        wanted = [name in ("means2d", *PARAMETERS) for name in GRADIENTS]
        gradients = dict(zip(GRADIENTS, OPS.rasterize_vjp(*self.backward, wanted), strict=True))
        OPS.observe_(*self.statistics, self.radii, gradients["means2d"])
        OPS.adam_(list(self.values.values()), [gradients[name] for name in PARAMETERS], *self.adam)

    def fused(self) -> None:
        OPS.rasterize_vjp_step_(*self.backward, self.radii, list(range(6)), *self.adam, False, *self.statistics)

    def forward(self) -> tuple[Tensor, ...]:
        return OPS.rasterize(None, *self.scene, self.camera.bg, False, True)

    @torch.no_grad()
    def whole(self) -> None:
        color, transmittance, _, radii, splats, counts, *lists, last, layers = self.forward()
        _, _, kept = torch.ops.fused_ssim.photometric(color, self.target, 0.2, True)
        gradient = torch.ops.fused_ssim.photometric_vjp(color, self.target, kept, 0.2, self.one)
        backward = splats, *lists, self.camera.bg, last, transmittance, gradient, None, None, counts, layers
        rest = radii, list(range(6)), *self.adam, False, *self.statistics
        OPS.rasterize_vjp_step_(*self.scene, *backward, *rest)


def by_turns(calls: list[Callable[[], None]], repeats: int) -> list[float]:
    """Return the median milliseconds of each call; they take turns, so that a busy machine slows all alike."""
    times: list[list[float]] = [[] for _ in calls]
    for turn in range(repeats + 1):
        for call, taken in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if turn:  # the first warms up
                taken.append(1e3 * (time.perf_counter() - start))
    return [median(taken) for taken in times]


def measure_on_cpu(repeats: int) -> None:
    rows = []
    for n, width, height, sigma in CPU_WORKLOADS:
        scene = frustum(n, width, height, sigma)
        steps = Steps(scene.parameters, scene.settings(torch.float32), blended=False)
        parts, fused = by_turns([steps.in_parts, steps.fused], repeats)
        rows.append([f"{n // 1000} k, {width}x{height}", f"{parts:.1f}", f"{fused:.1f}", f"{fused / parts:.2f}"])
    print_table(["splats, image", "project_vjp, observe, adam", "fused", "fused / in parts"], rows)


def measure_on_gpu() -> None:
    rows, whole = [], []
    for name, workload in WORKLOADS.items():
        scene = frustum(*workload, device="cuda")
        steps = Steps(scene.parameters, scene.settings(torch.float32), blended=True)
        whole.append([name, *_whole(steps)])
        calls = steps.in_parts, steps.fused
        peaks = [f"{peak_mib(call, lambda: None):.0f}" for call in calls]
        parts, fused = (min(_after_blending(call) for _ in range(2)) for call in calls)
        rows.append([name, f"{parts:.3f}", f"{fused:.3f}", f"{fused / parts:.2f}", *peaks])
        del steps, calls, scene
        torch.cuda.empty_cache()
    print_table(["", "project_vjp, observe, adam", "fused", "fused / in parts", "peak in parts", "fused"], rows)
    print()
    print_table(["", "forward", "its kernels", "step", "its kernels", "peak MiB"], whole)


def _whole(steps: Steps) -> list[str]:
    """Cells for the whole step and its forward."""
    forward, step = gpu_time(steps.forward), gpu_time(steps.whole)
    times = forward.wall, forward.kernels, step.wall, step.kernels
    return [*[f"{milliseconds:.3f}" for milliseconds in times], f"{peak_mib(steps.whole, lambda: None):.0f}"]


def _after_blending(call: Callable[[], None]) -> float:
    """Return the milliseconds of the kernels after blend_vjp."""
    launched = gpu_time(call).launched
    last = max(place for place, kernel in enumerate(launched) if kernel.name == "blend_vjp_kernel")
    return sum(kernel.milliseconds for kernel in launched[last + 1 :])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], help="default: cuda if there is a GPU and CUDA kernels")
    parser.add_argument("--repeats", type=int, default=15, help="CPU: number of timed calls (default: 15)")
    args = parser.parse_args()
    found = compute_device().type
    if args.device == "cuda" and found != "cuda":
        raise UserError("--device cuda needs a visible GPU and the rasterizer built with CUDA (GS_CUDA=1)")
    device = args.device or found
    print(describe(device))
    if device == "cuda":
        measure_on_gpu()
    else:
        measure_on_cpu(args.repeats)


if __name__ == "__main__":
    run_cli(main)
