"""Memory of a Gaussian on the ranks that run this, or on one process, and a training of many.

    python -m benchmarks.parallel.memory --gaussians 5000000 20000000
    torchrun --standalone --nproc_per_node 2 -m benchmarks.parallel.memory --train 50000000

The scene is the city of benchmarks.parallel.steps, with several numbers of Gaussians at one image size. A few steps
are taken; a line through the peaks gives bytes a Gaussian, and the most Gaussians for 92 % of the GPUs. With --train so
many are trained, with the learning rates of train.py.
"""

import argparse
import gc
import sys
import time

import torch

from benchmarks.harness.environment import describe, print_table
from benchmarks.parallel.run import WorkloadRun
from benchmarks.parallel.steps import synchronize
from benchmarks.parallel.workload import CITY, Workload
from training.loop import run_training
from training.objective import Losses
from training.observer import Observer
from training.observers.divergence import DivergenceWatch
from training.step import Step
from utils.host.process import peak_memory_mib
from utils.ranks.ranks import ranks
from utils.system_utils import UserError, compute_device, run_cli

_USABLE = 0.92  # of a GPU
_STEPS = 4
_GIB = 2**30
_HEADER = ["", "peak GiB by rank before the last step", "peak GiB by rank", "GiB of the GPU in use"]


class Progress(Observer):
    """Keeps the losses, and the time of every so many steps."""

    def __init__(self, device: torch.device, every: int) -> None:
        self._device, self._every = device, every
        self._losses: list[torch.Tensor] = []
        self.ends: list[float] = []
        self.peak_mib = 0.0  # before the last step

    def due(self, step: Step) -> bool:
        return False

    def begins(self, step: Step) -> None:
        if step.last:
            self.peak_mib = peak_memory_mib(self._device) or 0.0

    def measured(self, step: Step, losses: Losses) -> None:
        self._losses.append(losses.total.detach().clone())

    def stepped(self, step: Step) -> None:
        if step.iteration % self._every == 0:
            synchronize(self._device)
            self.ends.append(time.perf_counter())
            print(f"step {step.iteration}: loss {float(self._losses[-1]):.5f}", flush=True)

    @property
    def losses(self) -> list[float]:
        return torch.stack(self._losses).tolist()


def train(workload: Workload, steps: int, every: int) -> tuple[Progress, list[tuple[float, ...]]]:
    """Train: the progress, and bytes by rank: peak before the last step, peak, and of the GPU in use at the end.

    The last step of a training writes gradients, as steps do that add or remove Gaussians; others write none.
    """
    device = compute_device()
    gc.collect()
    run = WorkloadRun(workload, "tiles", steps, still=False)
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    progress = Progress(device, every)
    run.begin()
    run_training(run, [DivergenceWatch(run), progress])
    own = 2**20 * progress.peak_mib, 2**20 * (peak_memory_mib(device) or 0.0), _taken(device)
    return progress, list(zip(*ranks().everyone(own), strict=True))


def _taken(device: torch.device) -> float:
    if device.type != "cuda":
        return 0.0
    free, total = torch.cuda.mem_get_info()
    return float(total - free)


def measure(counts: list[int], size: tuple[int, int] | None) -> None:
    """Print the peaks of several numbers of Gaussians, and what follows from them."""
    peaks: list[list[float]] = []
    for count in counts:
        workload = CITY.changed(count, size)
        _, found = train(workload, _STEPS, _STEPS)
        peaks.append([max(by_rank) for by_rank in found])
        print_table(_HEADER, [_cells(workload, found)])
        sys.stdout.flush()
    for name, first, last in zip(_HEADER[1:3], peaks[0], peaks[-1], strict=False):
        each = (last - first) / (counts[-1] - counts[0])
        fixed = first - each * counts[0]
        told = f"{name}: {each * ranks().size:.0f} bytes a Gaussian over all ranks, and {fixed / _GIB:.2f} GiB on each"
        if torch.cuda.is_available() and each > 0:
            most = (_USABLE * torch.cuda.mem_get_info()[1] - fixed) / each
            told += f", so {most / 1e6:.0f} M Gaussians fit"
        print(told)


def _cells(workload: Workload, found: list[tuple[float, ...]]) -> list[str]:
    return [f"{workload}", *(" ".join(f"{x / _GIB:.2f}" for x in by_rank) for by_rank in found)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--gaussians", type=int, nargs="*", default=[5_000_000, 10_000_000, 20_000_000],
        help="numbers to measure, ascending, at least two or none (default: 5, 10 and 20 M)")  # fmt: skip
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the image (default: 3840 2160)")
    add("--train", type=int, metavar="N", help="train N Gaussians afterwards (default: none)")
    add("--iterations", type=int, default=200, help="of that training (default: 200)")
    args = parser.parse_args()
    if len(args.gaussians) == 1:
        raise UserError("--gaussians takes at least two numbers, or none")
    print(describe(compute_device()), flush=True)
    if args.gaussians:
        measure(args.gaussians, args.size)
    if args.train:
        workload = CITY.changed(args.train, args.size)
        progress, found = train(workload, args.iterations, max(args.iterations // 10, 1))
        losses, ends = progress.losses, progress.ends
        step = 1e3 * (ends[-1] - ends[0]) / (args.iterations * (len(ends) - 1) / len(ends))
        print(f"{workload}: {args.iterations} steps by {ranks().size} ranks, {step:.1f} ms each")
        print(f"loss {losses[0]:.5f} to {losses[-1]:.5f}")
        print_table(_HEADER, [_cells(workload, found)])


if __name__ == "__main__":
    run_cli(main, several=True)
