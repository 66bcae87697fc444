"""Run time of the rasterizer on seeded workloads, on a CPU or a GPU.

    python -m benchmarks.kernels.rasterizer                  # on the GPU if there is one and the build has CUDA
    python -m benchmarks.kernels.rasterizer --device cpu
    python -m benchmarks.kernels.rasterizer --order morton   # rows as trainings keep them; default: at random
    python -m benchmarks.kernels.rasterizer --projection ray --lens fisheye --workloads M L
    python -m benchmarks.kernels.rasterizer --models OUT ...  # models of train.py in place of seeded workloads

Milliseconds are medians. An instance is a splat in a tile. Processed instances are those that the backward reads: in
each tile, those up to the last one that a pixel of the tile blends. A GPU's tables also have peak memory, and stages
and kernels of a step; beside them stand figures of other implementations.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from diff_gaussian_rasterization.lens import Lens

from arguments import ModelParams, PipelineParams, read_cfg_args
from benchmarks.harness.calls import STAGES, TILE, Calls, Stages, group_by_stage
from benchmarks.harness.measuring import (
    REPEATS,
    WARM_UPS,
    GpuTime,
    add_device,
    choose_device,
    cpu_milliseconds,
    describe_machine,
    gpu_time,
    measure_peak_mib,
    print_table,
)
from gaussian_renderer import rasterizer_settings, render
from scene.saved_model import load_saved
from tests.workloads.splat_scenes import (
    COLUMNS,
    CPU_WORKLOADS,
    GPU_WORKLOADS,
    ORDERS,
    PARAMETERS,
    SplatScene,
    frustum,
)
from utils.system_utils import UserError, run_cli

CPU_STAGES = ("project", "bin", "blend", "blend_rows", "rows_vjp")

# Figures of other implementations: ms and MiB on one NVIDIA H200, measured in one run (torch 2.11+cu130, CUDA 13.0;
# medians, host included), on the tensors that splat_scenes.frustum draws on the GPU with seed 0. Of forward, forward +
# backward, and both with one dense Adam step of all tensors:
FASTER_GS = {
    "S": (0.41, 1.16, 1.21),
    "M": (0.80, 2.89, 3.29),
    "M+": (1.07, 3.61, 4.03),
    "L": (1.65, 6.19, 7.39),
    "XL": (2.40, 9.73, 12.1),
}
GSPLAT = {
    "S": (1.11, 2.47, 2.95),
    "M": (1.79, 4.64, 5.48),
    "M+": (2.11, 5.68, 6.61),
    "L": (3.83, 9.62, 11.5),
    "XL": (6.16, 15.2, 18.9),
}
# Peak memory above the inputs: of forward alone, and of forward + backward, gradients included.
FASTER_GS_MEMORY = {"S": (29, 133), "M+": (159, 900), "L": (362, 2175), "XL": (651, 3942)}
GSPLAT_MEMORY = {"S": (50, 54), "M+": (411, 482), "L": (1127, 1397), "XL": (2169, 2772)}


def measure_on_cpu(scene: SplatScene, repeats: int) -> dict[str, float]:
    """Return the milliseconds of forward, forward + backward and each stage, and the amount of work."""
    calls, stages = Calls(scene), Stages(scene)
    result = {"forward": cpu_milliseconds(calls.forward, repeats)}
    result["+ backward"] = cpu_milliseconds(calls.with_backward, repeats)
    with torch.no_grad():
        result |= dict.fromkeys(CPU_STAGES, math.nan)
        result |= {name: cpu_milliseconds(run, repeats) for name, run in stages.calls.items()}
    return result | {"instances": len(stages.instances), "processed": stages.processed}


def print_cpu(scenes: Iterator[tuple[str, SplatScene]], thread_counts: list[int], repeats: int) -> None:
    """Print times and rates. Evaluations: processed instances x 256 pixels."""
    header = ["splats, image", "threads", "forward", "+ backward", *CPU_STAGES, "instances", "processed"]
    rows = []
    for name, scene in scenes:
        for threads in dict.fromkeys(thread_counts):
            torch.set_num_threads(threads)
            found = measure_on_cpu(scene, repeats)
            evaluations = found["processed"] * TILE * TILE / threads / 1e6
            row = [f"{name}: {len(scene.parameters['means']) / 1e3:.0f} k, {scene.width}x{scene.height}", str(threads)]
            row += [f"{found[name]:.1f}" for name in header[2:9]]
            row += [f"{found[name] / 1e3:.0f} k" for name in ("instances", "processed")]
            rows.append([*row, *(f"{evaluations / found[name]:.2f}" for name in ("blend", "blend_rows"))])
    print_table([*header, "G evaluations/s/core forward", "backward"], rows)


@dataclass
class Measured:
    """A workload on a GPU: times by step, and peak memory above the inputs of forward and + backward, MiB."""

    name: str
    times: dict[str, GpuTime]
    memory: list[float]

    def kernels(self) -> list[tuple[str, str, float]]:
        """Return stage, name and milliseconds of the kernels of a step, in order."""
        return group_by_stage(self.times["step"].launched)


def measure_on_gpu(name: str, scene: SplatScene) -> Measured:
    """Measure a workload."""
    calls = Calls(scene)
    # Memory first: Adam's averages would not count, but the memory that they leave in the pool could.
    memory = [measure_peak_mib(run, calls.clear) for run in (calls.forward, calls.with_backward)]
    times = {step: gpu_time(run) for step, run in calls.steps().items()}
    del calls
    torch.cuda.empty_cache()
    return Measured(name, times, memory)


def print_gpu(scenes: Iterator[tuple[str, SplatScene]]) -> None:
    """Measure the workloads and print every table."""
    found = [measure_on_gpu(name, scene) for name, scene in scenes]
    names = [workload.name for workload in found]
    for workload in found:
        print(f"\nKernels of a step in order, {workload.name}")
        print_table(["stage", "kernel", "ms"], [[stage, name, f"{ms:.4f}"] for stage, name, ms in workload.kernels()])
    print("\nStages of a step, ms of kernels")
    sums = {(w.name, stage): sum(ms for of, _, ms in w.kernels() if of == stage) for w in found for stage in STAGES}
    print_table(["", *names], [[stage, *(f"{sums[name, stage]:.3f}" for name in names)] for stage in STAGES])
    print("\nPeak memory above the inputs, gradients included, MiB")
    header = ["workload", "forward", "Faster-GS", "gsplat", "+ backward", "Faster-GS", "gsplat"]
    print_table(header, [_make_memory_row(workload) for workload in found])
    print(f"\nMs: medians of {REPEATS} calls after {WARM_UPS}, each on an idle device. Call: events around the call,")
    print("host included. Kernels: the device's own work.")
    header = ["workload", "", "call", "kernels", "Faster-GS", "gsplat", "call / Faster-GS"]
    print_table(header, [row for workload in found for row in _make_time_rows(workload)])


def _make_memory_row(workload: Measured) -> list[str]:
    """Return the row of a workload's memory: ours, then that of Faster-GS and gsplat where they are known."""
    row = [workload.name]
    for i, own in enumerate(workload.memory):
        others = [of.get(workload.name) for of in (FASTER_GS_MEMORY, GSPLAT_MEMORY)]
        row += [f"{own:.0f}", *(str(other[i]) if other else "" for other in others)]
    return row


def _make_time_rows(workload: Measured) -> list[list[str]]:
    """Return the rows of a workload's times, ms: the call, its kernels, and the times of others where known."""
    rows = []
    for i, step in enumerate(workload.times):
        time = workload.times[step]
        row = [workload.name, step, f"{time.events:.3f}", f"{time.kernels:.3f}"]
        if workload.name in GSPLAT:
            theirs, gsplat = (of[workload.name][i] for of in (FASTER_GS, GSPLAT))
            row += [f"{theirs:.2f}", f"{gsplat:.2f}", f"{time.events / theirs:.2f}"]
        rows.append(row + [""] * (7 - len(row)))
    return rows


@torch.no_grad()
def load_trained(folder: Path) -> SplatScene:
    """Return the model that train.py has left in a folder, with the view that sees the median number of Gaussians.

    Seeded splats in a frustum are fog, in which three quarters of the instances are hidden; of a trained model few are,
    and its rows lie in Morton order. UserError where the folder has no model, or its scene is missing.
    """
    parser = argparse.ArgumentParser()
    models, pipelines = ModelParams(parser), PipelineParams(parser)
    options = argparse.Namespace(**vars(parser.parse_args([])) | read_cfg_args(folder) | {"model_path": str(folder)})
    scene, pipe = load_saved(models.extract(options), -1), pipelines.extract(options)
    gaussians, background = scene.gaussians, torch.zeros(3, device=scene.gaussians.get_xyz.device)
    views = sorted(scene.getTrainCameras(), key=lambda view: view.image_name)
    seen = [int((render(view, gaussians, pipe, background)["radii"] > 0).sum()) for view in views]
    view = views[sorted(range(len(views)), key=seen.__getitem__)[len(views) // 2]]
    rows = {name: gaussians.raw(column).detach().clone() for name, column in zip(PARAMETERS, COLUMNS, strict=True)}
    return SplatScene(rows, view.image_width, view.image_height, rasterizer_settings(view, gaussians, pipe, background))


def load_workloads(args: argparse.Namespace, device: str) -> Iterator[tuple[str, SplatScene]]:
    """The requested workloads by name, one after the other: several may not fit into memory."""
    sizes = GPU_WORKLOADS if device == "cuda" else CPU_WORKLOADS
    if unknown := [name for name in args.workloads or () if name not in sizes]:
        raise UserError(f"--workloads {unknown[0]}: on this device there are {', '.join(sizes)}")
    if args.models:
        scenes = ((folder.name, load_trained(folder).to(device)) for folder in args.models)
    else:
        names = args.workloads or sizes
        scenes = ((name, ORDERS[args.order](frustum(*sizes[name], device=device))) for name in names)
    return ((name, set_lens(scene, args.projection, args.lens)) for name, scene in scenes)


def set_lens(scene: SplatScene, projection: str, lens: str | None) -> SplatScene:
    """The scene of that projection and kind of lens, whose middle has the pinhole's angle of view, or 360 degrees."""
    settings = scene.settings(projection=projection)
    if lens is None:
        return replace(scene, camera=settings)
    width, height = scene.width, scene.height
    focal = width / (2 * settings.tanfovx) if lens == "brown" else width / (2 * math.atan(settings.tanfovx))
    center = (width - 1) / 2, (height - 1) / 2
    made = Lens("perspective" if lens == "brown" else "equidistant", (focal, focal), center, radial=(0.01, 0.01, 0, 0))
    if lens == "panorama":
        made = Lens("equirectangular", (width / (2 * math.pi), height / math.pi), center)
    return replace(scene, camera=settings._replace(lens=made))


def main() -> None:
    """Print the times of the workloads or models that the command line names, on a CPU or a GPU."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add_device(parser)
    add("--workloads", nargs="+", help=f"CPU: of {', '.join(CPU_WORKLOADS)}; GPU: of {', '.join(GPU_WORKLOADS)}")
    add("--models", type=Path, nargs="+", default=[], help="folders that train.py wrote, in place of workloads")
    add("--order", choices=list(ORDERS), default="random", help="of the rows (default: random, as drawn)")
    add("--projection", choices=["ewa", "ray"], default="ewa", help="how a pixel sees a Gaussian (default: ewa)")
    add("--lens", choices=["brown", "fisheye", "panorama"], help="in place of a pinhole")
    add("--threads", type=int, nargs="+", default=[1, torch.get_num_threads()], help="CPU: numbers of threads to use")
    add("--repeats", type=int, default=9, help="CPU: number of timed calls (default: 9)")
    args = parser.parse_args()
    device = choose_device(args)
    print(
        f"{describe_machine(device)}, rows: {'as trained' if args.models else args.order}, "
        f"projection: {args.projection}, lens: {args.lens or 'none'}"
    )
    if device == "cuda":
        print_gpu(load_workloads(args, device))
    else:
        print_cpu(load_workloads(args, device), args.threads, args.repeats)


if __name__ == "__main__":
    run_cli(main)
