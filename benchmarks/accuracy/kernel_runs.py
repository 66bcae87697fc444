"""Results and run times of the rasterizer's kernels on the scenes of the accuracy benchmark.

    python -m benchmarks.accuracy.kernel_runs MASKS RUNS [--times]

oracle.py uses this command to measure a build other than the installed one: the first one on PYTHONPATH. MASKS and RUNS
are torch files with the argument and the result of `run_all`; RUNS also holds the path of the build.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import diff_gaussian_rasterization
import torch
from diff_gaussian_rasterization import rasterize, reference
from torch import Tensor
from tqdm import tqdm

from benchmarks.harness.calls import Calls
from benchmarks.harness.timing import cpu_milliseconds, gpu_time
from benchmarks.workloads.splat_scenes import KINDS, PARAMETERS, SplatScene
from utils.system_utils import compute_device

# The oracle can only do thousands of splats on a small image, where the overhead of the calls would dominate the time.
# Times are therefore taken on more splats of the same family, at a size where work dominates on a GPU as well.
TIMED_SIZES = {
    "ordinary": (200_000, 1200, 900),
    "needles": (20_000, 1200, 900),
    "huge and tiny": (3_000, 1200, 900),
}
CPU_REPEATS = 5
PLANES = ("image", "inverse depth", "transmittance")


class Case(NamedTuple):
    """A scene and a setting to render it with."""

    kind: str  # a key of KINDS
    antialiasing: bool


class Kernel(NamedTuple):
    """A device and a dtype to render with."""

    device: str
    dtype: torch.dtype

    def __str__(self) -> str:
        return f"{self.device.replace('cpu', 'CPU').replace('cuda', 'CUDA')} {str(self.dtype).removeprefix('torch.')}"


class Run(NamedTuple):
    """A kernel's result for a case."""

    tensors: dict[str, Tensor]  # by name, on the CPU: planes, zero at the pixels left out, and gradients
    milliseconds: float | None  # forward + backward of the timed scene; None unless timed


CASES = [Case(kind, antialiasing) for antialiasing in (False, True) for kind in KINDS]
CPU_FLOAT, CPU_DOUBLE = Kernel("cpu", torch.float32), Kernel("cpu", torch.float64)
CUDA_FLOAT = Kernel("cuda", torch.float32)


def kernels() -> list[Kernel]:
    """List the kernels of this build that can run on this machine."""
    return [CPU_FLOAT, CPU_DOUBLE, *([CUDA_FLOAT] if compute_device().type == "cuda" else [])]


def run_oracle(case: Case) -> tuple[dict[str, Tensor], Tensor]:
    """Return the true values of `Run.tensors`, and the pixels that count, (H, W) bool."""
    scene = KINDS[case.kind]()
    leaves, means2d, settings, named = _arguments(scene, CPU_DOUBLE, case.antialiasing)
    out = reference.render(leaves["means"], means2d, leaves["opacities"], settings, **named)
    keep = ~out.near_cut
    planes = (out.color, out.inverse_depth, out.transmittance)
    return _differentiate(planes, keep, leaves, means2d), keep


def run_all(masks: dict[Case, Tensor], times: bool) -> dict[tuple[Case, Kernel], Run]:
    """Run every kernel on every case of `masks` ((H, W) bool: the pixels that count), with times if `times`."""
    jobs = [(case, kernel) for case in masks for kernel in kernels()]
    bar = tqdm(jobs, desc="Kernels", unit="run", leave=False)
    return {
        (case, kernel): Run(_tensors(case, kernel, masks[case]), _milliseconds(case, kernel) if times else None)
        for case, kernel in bar
    }


def _tensors(case: Case, kernel: Kernel, keep: Tensor) -> dict[str, Tensor]:
    scene = KINDS[case.kind]().to(kernel.device)
    leaves, means2d, settings, named = _arguments(scene, kernel, case.antialiasing)
    named |= {"want_inverse_depth": True, "want_transmittance": True}
    out = rasterize(leaves["means"], means2d, leaves["opacities"], settings, **named)
    planes = (out.color, out.inverse_depth, out.transmittance)
    return _differentiate(planes, keep.to(kernel.device), leaves, means2d)


def _arguments(scene: SplatScene, kernel: Kernel, antialiasing: bool) -> tuple:
    """Return leaves, means2d, settings and named arguments. The camera is float64; each kernel rounds it."""
    leaves = scene.leaves(kernel.dtype)
    named = {name: leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")} | {"raw": True}
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    return leaves, means2d, scene.settings(torch.float64, antialiasing=antialiasing), named


def _differentiate(
    planes: tuple[Tensor, ...], keep: Tensor, leaves: dict[str, Tensor], means2d: Tensor
) -> dict[str, Tensor]:
    """Return the planes, and the gradients of their sum over the pixels that count, with fixed random weights."""
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(plane.shape, generator=generator, dtype=torch.float64).to(plane) for plane in planes]
    sum((plane * weight * keep).sum() for plane, weight in zip(planes, weights, strict=True)).backward()
    tensors = {name: (plane * keep).detach() for name, plane in zip(PLANES, planes, strict=True)}
    tensors |= {f"d {name}": leaves[name].grad for name in PARAMETERS} | {"d screen mean": means2d.grad[:, :2]}
    return {name: tensor.cpu() for name, tensor in tensors.items()}


def _milliseconds(case: Case, kernel: Kernel) -> float:
    """Time forward and backward of one image; on a GPU by events, which include the host's part of the call."""
    scene = KINDS[case.kind](*TIMED_SIZES[case.kind]).to(kernel.device)
    call = Calls(scene, kernel.dtype, case.antialiasing).with_backward
    return gpu_time(call).events if kernel.device == "cuda" else cpu_milliseconds(call, CPU_REPEATS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("masks", type=Path, help="torch file with the pixels that count in each case")
    parser.add_argument("runs", type=Path, help="torch file to write the runs to")
    parser.add_argument("--times", action="store_true", help="time the kernels as well")
    args = parser.parse_args()
    masks = {Case(*case): mask for case, mask in torch.load(args.masks).items()}
    runs = {(*case, *kernel): tuple(run) for (case, kernel), run in run_all(masks, args.times).items()}
    torch.save({"package": diff_gaussian_rasterization.__file__, "runs": runs}, args.runs)


if __name__ == "__main__":
    main()
