"""Steps of training by the ranks that run this, or by one process: time, where it goes, bytes sent, and memory.

    python -m benchmarks.parallel.steps --workload XL
    torchrun --standalone --nproc_per_node 2 -m benchmarks.parallel.steps --workload XL --parallel tiles

A step is that of train.py: draw, loss against a photo, Adam. XL is the workload of the other benchmarks; city has 20 M
Gaussians at 3840x2160, a plane of blocks seen from above, which each rank draws for itself. Learning rates are 0, so
that all steps do the same. By themselves, steps are timed in blocks, at whose ends the GPU is waited for. Then come
steps with marks around their stages, which are a little slower. One process has no stages inside the rasterizer.
`benchmarks.parallel.table` runs this with several numbers of ranks.
"""

import argparse
import gc
import json
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.harness.environment import describe, print_table
from benchmarks.parallel.run import WorkloadRun
from benchmarks.parallel.stages import STAGES, Stages
from benchmarks.parallel.workload import ALL, Workload
from training.loop import run_training
from training.observer import Observer
from training.observers.divergence import DivergenceWatch
from training.step import Step
from utils.host.process import peak_memory_mib
from utils.ranks.ranks import ranks
from utils.system_utils import UserError, compute_device, run_cli

MIB = 2**20
_LINK_BYTES, _LINK_CALLS = 2**28, 10  # to each rank; on a GPU


class Timing(Observer):
    """Times blocks of steps after a warm-up, and then marks the stages of as many steps as are left."""

    def __init__(self, device: torch.device, warm_up: int, block: int, blocks: int) -> None:
        self._device, self._first, self._block, self._blocks = device, warm_up, block, blocks
        self._ends: list[float] = []
        self.stages = Stages(device)
        self._watching = None
        self.staged = 0
        self.peak_mib = 0.0

    def due(self, step: Step) -> bool:
        # One process then takes its steps one by one, and not as a recorded graph.
        return self._watching is not None and not ranks().several

    def begins(self, step: Step) -> None:
        if step.last and self._watching is not None:
            self._watching.__exit__(None, None, None)

    def stepped(self, step: Step) -> None:
        done = step.iteration - self._first
        if self._watching is None and done >= 0 and done % self._block == 0:
            synchronize(self._device)
            self._ends.append(time.perf_counter())
            if len(self._ends) > self._blocks:
                self.peak_mib = peak_memory_mib(self._device) or 0.0
                self._watching = self.stages.watching(ranks())
                self._watching.__enter__()
        elif self._watching is not None and not step.last:
            self.stages.mark()
            self.staged += 1

    @property
    def milliseconds(self) -> list[float]:
        """Of a step, by block."""
        return [1e3 * (end - begin) / self._block for begin, end in zip(self._ends, self._ends[1:], strict=False)]


def synchronize(device: torch.device) -> None:
    """Wait for the GPU, if there is one."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure(workload: Workload, parallel: str, args: argparse.Namespace) -> dict[str, Any]:
    """Take steps; returns what rank 0 needs to know of all ranks."""
    device, here = compute_device(), ranks()
    steps = args.warm_up + args.block * args.blocks + args.staged + 1
    run = WorkloadRun(workload, parallel, steps, still=True)
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    timing = Timing(device, args.warm_up, args.block, args.blocks)
    run.begin()
    run_training(run, [DivergenceWatch(run), timing])
    spent = {stage: ms / timing.staged for stage, ms in timing.stages.milliseconds().items()}
    sent = {stage: count / timing.staged for stage, count in timing.stages.bytes.items()}
    own = {"ms": timing.milliseconds, "stages": spent, "sent": sent, "peak_mib": timing.peak_mib}
    views = here.size if parallel == "views" else 1
    return {
        "workload": str(workload),
        "parallel": parallel if here.several else "one process",
        "ranks": here.size,
        "views": views,
        "by_rank": here.everyone(own),
    }


def link_speed() -> float:
    """Bytes a second that a rank sends in an exchange of much with all others; 0 of one process."""
    here, device = ranks(), compute_device()
    if not here.several:
        return 0.0
    each = _LINK_BYTES if device.type == "cuda" else _LINK_BYTES // 16
    rows, sizes = torch.zeros(here.size * each, dtype=torch.uint8, device=device), [each] * here.size
    seconds = []
    for _ in range(_LINK_CALLS + 1):
        synchronize(device)
        here.anyone(False)
        start = time.perf_counter()
        here.send(rows, sizes, sizes)
        synchronize(device)
        seconds.append(time.perf_counter() - start)
    return each * (here.size - 1) / median(seconds[1:])


def milliseconds(found: dict[str, Any]) -> float:
    """Median of the slowest rank."""
    return max(median(own["ms"]) for own in found["by_rank"])


def summary(found: dict[str, Any], link: float) -> list[str]:
    """Cells of a measurement: ranks, what they share, ms, spread, images, bytes, the links' part, memory."""
    step, every = milliseconds(found), found["by_rank"]
    spread = [ms for own in every for ms in own["ms"]]
    sent = max(sum(own["sent"].values()) for own in every)
    return [
        found["workload"],
        f"{found['ranks']}",
        found["parallel"],
        f"{step:.3f}",
        f"{min(spread):.3f} to {max(spread):.3f}",
        f"{1e3 * found['views'] / step:.1f}",
        f"{sent / MIB:.2f}",
        f"{1e3 * sent / link:.3f}" if link else "-",
        " ".join(f"{own['peak_mib'] / 1024:.2f}" for own in every),
    ]


SUMMARY = ["workload", "ranks", "shared", "ms a step", "blocks", "images/s", "MiB sent", "ms at the links' limit",
           "peak GiB by rank"]  # fmt: skip


def stage_rows(found: dict[str, Any]) -> list[list[str]]:
    """Rows by stage: milliseconds, the mean over ranks and the range, and MiB sent by the rank that sends most."""
    rows = []
    for stage in STAGES:
        spent = [own["stages"].get(stage, 0.0) for own in found["by_rank"]]
        sent = max(own["sent"].get(stage, 0.0) for own in found["by_rank"])
        if max(spent):
            span = f"{min(spent):.3f} to {max(spent):.3f}"
            rows.append([stage, f"{sum(spent) / len(spent):.3f}", span, f"{sent / MIB:.3f}" if sent else ""])
    return rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what a measurement can be given."""
    add = parser.add_argument
    add("--workload", nargs="+", choices=list(ALL), default=list(ALL), help="default: all")
    add("--parallel", nargs="+", choices=["tiles", "views"], default=["tiles", "views"], help="default: both")
    add("--gaussians", type=int, help="in place of the workload's")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the image, in place of the workload's")
    add("--warm_up", type=int, default=24, help="steps (default: 24)")
    add("--block", type=int, default=5, help="steps of a block (default: 5)")
    add("--blocks", type=int, default=20, help="default: 20")
    add("--staged", type=int, default=16, help="steps whose stages are timed (default: 16)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_options(parser)
    parser.add_argument("--json", type=Path, help="file for the numbers")
    args = parser.parse_args()
    if min(args.warm_up, args.block, args.blocks, args.staged) < 1:
        raise UserError("--warm_up, --block, --blocks and --staged take numbers from 1 on")
    print(describe(compute_device()))
    link = link_speed()
    print(f"{ranks().size} ranks" + (f", links {link / 1e9:.1f} GB/s a rank" if link else ""), flush=True)
    results = []
    for name in args.workload:
        for parallel in args.parallel if ranks().several else ["tiles"]:
            results.append(measure(ALL[name].changed(args.gaussians, args.size), parallel, args))
            gc.collect()
            print_table(SUMMARY, [summary(results[-1], link)])
            print_table(["stage", "ms", "over ranks", "MiB sent"], stage_rows(results[-1]))
            print(flush=True)
    if args.json and ranks().first:
        args.json.write_text(json.dumps({"link": link, "results": results}), encoding="utf-8")


if __name__ == "__main__":
    run_cli(main, several=True)
