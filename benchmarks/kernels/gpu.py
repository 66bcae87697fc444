"""Tables of the rasterizer on a GPU: times beside marks and other implementations, work, memory, stages, kernels."""

from dataclasses import dataclass, field

import torch

from benchmarks.harness.calls import Calls, Stages
from benchmarks.harness.environment import print_table
from benchmarks.harness.timing import REPEATS, WARM_UPS, GpuTime, gpu_time, peak_mib
from benchmarks.kernels.fragments import SUB_TILES, fragments, processed_per_tile
from benchmarks.peers import published
from benchmarks.peers.gsplat_calls import GsplatCalls, version
from benchmarks.workloads.splat_scenes import SplatScene, frustum

# Kernels that separate the stages of a step: those of _BEGINS begin the named stage; it begins after those of _NEXT.
_BEGINS = {"blend_kernel": "blend", "blend_chunks_kernel": "blend", "adam_kernel": "adam"}
_NEXT = {"project_kernel": "bin", "blend_vjp_kernel": "project_vjp"}
_NEXT |= dict.fromkeys(("blend_kernel", "blend_chunks_kernel"), "blend_vjp")


@dataclass
class Measured:
    """Measurements of one implementation on one workload."""

    times: dict[str, GpuTime]
    memory: tuple[float, float]  # peak above the inputs, MiB: forward, + backward
    difference: tuple[float, float] | None = None  # between its image and ours: largest, median


@dataclass
class Workload:
    """Our measurements on one workload, the amount of work, and the other implementations' measurements."""

    name: str
    ours: Measured
    instances: int
    processed: int
    fragments: dict[str, float]
    peers: dict[str, Measured] = field(default_factory=dict)


def measure_on_gpu(names: list[str], peers: list[str]) -> None:
    """Time workloads of published.py, by name, and print every table."""
    gsplat = f"gsplat {version()}" if "gsplat" in peers else None
    workloads = [_measure(name, gsplat) for name in names]
    for workload in workloads:
        _print_kernels(workload)
    _print_stages(workloads)
    _print_work(workloads)
    _print_memory(workloads)
    if gsplat:
        _print_peers(workloads)
    _print_times(workloads)


def _measure(name: str, gsplat: str | None) -> Workload:
    scene = frustum(*published.WORKLOADS[name], device="cuda")
    calls = Calls(scene)
    image = calls.forward()
    ours = _measure_calls(calls)
    stages = Stages(scene)
    counted = fragments(stages.splats, stages.instances, stages.ranges, stages.last)
    processed = int(processed_per_tile(stages.last).sum())
    workload = Workload(name, ours, len(stages.instances), processed, counted)
    del stages
    if gsplat:
        for title, packed in ((gsplat, False), (f"{gsplat}, packed", True)):
            workload.peers[title] = _measure_peer(scene, packed, image)
    torch.cuda.empty_cache()
    return workload


def _measure_calls(calls: Calls | GsplatCalls) -> Measured:
    # Measure memory first: Adam's averages would not count, but the memory that they leave in the pool could.
    memory = tuple(peak_mib(run, calls.clear) for run in (calls.forward, calls.with_backward))
    times = {step: gpu_time(run) for step, run in calls.steps().items()}
    calls.clear()
    return Measured(times, memory)


def _measure_peer(scene: SplatScene, packed: bool, image: torch.Tensor) -> Measured:
    calls = GsplatCalls(scene, packed)
    off = (calls.forward() - image).abs()
    result = _measure_calls(calls)
    result.difference = (float(off.max()), float(off.median()))
    return result


def _print_times(workloads: list[Workload]) -> None:
    header = ["workload", "", "call", "wall clock", "kernels", "waits", "Faster-GS", "call / Faster-GS", "at most"]
    header += ["mark for kernels", "kernels / mark"]
    rows = []
    for workload in workloads:
        for i, step in enumerate(published.STEPS):
            time, theirs = workload.ours.times[step], published.FASTER_GS[workload.name][i]
            mark, bound = published.MARKS[workload.name][i], published.BINDING.get(step)
            row = [workload.name, step, f"{time.events:.3f}", f"{time.wall:.3f}", f"{time.kernels:.3f}"]
            row += [str(time.waits), f"{theirs:.2f}", f"{time.events / theirs:.2f}", f"{bound or ''}"]
            rows.append([*row, f"{mark:.2f}", f"{time.kernels / mark:.2f}"])
    title = f"Time, ms: medians of {REPEATS} calls after {WARM_UPS}, each on an idle device. Call: events around the "
    title += "public call, host included. Kernels: the device's own work. Waits: of the host, in a call."
    _print(title, header, rows)


def _print_work(workloads: list[Workload]) -> None:
    sub_tiles = ["{}x{}".format(*size) for size in SUB_TILES]
    header = ["workload", "instances", "processed", *(f"evaluated, {size}" for size in sub_tiles), "blended"]
    rows = [
        [w.name, f"{w.instances / 1e6:.2f} M", f"{w.processed / 1e6:.2f} M"]
        + [f"{w.fragments[key]:.0f}" for key in (*sub_tiles, "blended")]
        for w in workloads
    ]
    _print("Work (evaluated and blended: fragments a pixel; ours are 8x8 forward, 16x8 backward)", header, rows)


def _print_memory(workloads: list[Workload]) -> None:
    header = ["workload", "forward", "Faster-GS", "gsplat", "+ backward", "Faster-GS", "gsplat", "mark"]
    rows = []
    for w in workloads:
        row = [w.name]
        for i in range(2):
            others = [of.get(w.name) for of in (published.FASTER_GS_MEMORY, published.GSPLAT_MEMORY)]
            row += [f"{w.ours.memory[i]:.0f}", *(str(other[i]) if other else "" for other in others)]
        rows.append([*row, str(published.MEMORY_MARKS[w.name])])
    _print("Peak memory above the inputs, gradients included, MiB", header, rows)


def _print_stages(workloads: list[Workload]) -> None:
    names = ["project", "bin", "blend", "blend_vjp", "project_vjp", "adam"]
    columns = []
    for w in workloads:
        n, width, height, _ = published.WORKLOADS[w.name]
        floors = published.floors(n, width * height, w.instances, w.processed, w.fragments["8x4"])
        kernels = w.ours.times["step"].launched
        took = dict.fromkeys(names, 0.0)
        for stage, kernel in zip(_stages_of([k.name for k in kernels]), kernels, strict=True):
            took[stage] += kernel.milliseconds
        columns.append([f"{took[stage]:.3f} / {floors[stage]:.3f}" for stage in names])
    rows = [[stage, *(column[i] for column in columns)] for i, stage in enumerate(names)]
    _print("Stages of a step: kernel time / floor", ["", *(w.name for w in workloads)], rows)


def _print_kernels(workload: Workload) -> None:
    kernels = workload.ours.times["step"].launched
    stages = _stages_of([k.name for k in kernels])
    rows = [[stage, k.name, str(k.launches), f"{k.milliseconds:.4f}"] for stage, k in zip(stages, kernels, strict=True)]
    _print(f"Kernels of a step in order, {workload.name}", ["stage", "kernel", "launches", "ms"], rows)


def _stages_of(names: list[str]) -> list[str]:
    """Return the stage of each kernel of a step, in order."""
    stage, result = "project", []
    for name in names:
        stage = _BEGINS.get(name, stage)
        result.append(stage)
        stage = _NEXT.get(name, stage)
    return result


def _print_peers(workloads: list[Workload]) -> None:
    header = ["workload", "implementation", *published.STEPS, "kernels", "its / ours", "peak forward, + backward MiB"]
    header += ["difference of its image, largest (median)"]
    rows = []
    for w in workloads:
        published_times = " / ".join(f"{ms:.2f}" for ms in published.GSPLAT[w.name])
        for title, peer in {"ours": w.ours, **w.peers}.items():
            times = [peer.times[step] for step in published.STEPS]
            ratios = [t.events / w.ours.times[step].events for t, step in zip(times, published.STEPS, strict=True)]
            row = [w.name, title, *(f"{t.events:.3f}" for t in times), " / ".join(f"{t.kernels:.3f}" for t in times)]
            row += [" / ".join(f"{r:.2f}" for r in ratios), "{:.0f}, {:.0f}".format(*peer.memory)]
            rows.append([*row, "{:.1e} ({:.0e})".format(*peer.difference) if peer.difference else ""])
        rows.append([w.name, "gsplat as published.py has it", *published_times.split(" / "), "", "", "", ""])
    _print("Beside others, same tensors, same run; call ms", header, rows)


def _print(title: str, header: list[str], rows: list[list[str]]) -> None:
    print(f"\n{title}")
    print_table(header, rows)
