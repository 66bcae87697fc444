"""Time of the host in a step of training, by function, of the ranks that run this or of one process.

    python -m benchmarks.parallel.host --workload XL --gaussians 20000
    torchrun --standalone --nproc_per_node 2 -m benchmarks.parallel.host --workload XL --gaussians 20000

Of rank 0, by Python's profiler, which makes each call a little slower; the time of a step without it comes first. With
few Gaussians a GPU waits for its host, so that the sum is the step. Where the host waits for a GPU, the time is that
of the call that waits, as `tolist`, `bin` and `blend_rows`.
"""

import argparse
import cProfile
import pstats
import time

from benchmarks.harness.environment import describe, print_table
from benchmarks.parallel.run import WorkloadRun
from benchmarks.parallel.steps import synchronize
from benchmarks.parallel.workload import ALL, Workload
from training.loop import run_training
from training.observer import Observer
from training.observers.divergence import DivergenceWatch
from training.step import Step
from utils.ranks.ranks import ranks
from utils.system_utils import UserError, compute_device, run_cli

_WARM_UP = 24  # steps


class Profile(Observer):
    """Times as many steps by the clock, and then by Python's profiler."""

    def __init__(self, steps: int) -> None:
        self._steps, self._device = steps, compute_device()
        self._profiler = cProfile.Profile()
        self.milliseconds = 0.0  # of a step by the clock

    def stepped(self, step: Step) -> None:
        done = step.iteration - _WARM_UP
        if done == 0:
            synchronize(self._device)
            self._began = time.perf_counter()
        elif done == self._steps:
            synchronize(self._device)
            self.milliseconds = 1e3 * (time.perf_counter() - self._began) / self._steps
            self._profiler.enable()
        elif done == 2 * self._steps:
            self._profiler.disable()

    def rows(self, most: int) -> list[list[str]]:
        """Of the functions that take most themselves: what, calls of a step, microseconds of a step."""
        found = pstats.Stats(self._profiler).stats.items()
        longest = sorted(found, key=lambda each: -each[1][2])[:most]
        return [
            [_named(*place), f"{calls / self._steps:.1f}", f"{1e6 * own / self._steps:.1f}"]
            for place, (_, calls, own, _, _) in longest
        ]


def profiled(workload: Workload, parallel: str, steps: int) -> Profile:
    """Take steps, and profile some of them."""
    run = WorkloadRun(workload, parallel, _WARM_UP + 2 * steps + 1, still=True)
    profile = Profile(steps)
    run.begin()
    run_training(run, [DivergenceWatch(run), profile])
    return profile


def _named(path: str, line: int, name: str) -> str:
    return name if path == "~" else f"{name} ({'/'.join(path.split('/')[-2:])}:{line})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--workload", choices=list(ALL), default="XL")
    add("--parallel", nargs="+", choices=["tiles", "views"], default=["tiles", "views"], help="default: both")
    add("--gaussians", type=int, help="in place of the workload's")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the image, in place of the workload's")
    add("--steps", type=int, default=100, help="default: 100")
    add("--functions", type=int, default=40, help="that are shown (default: 40)")
    args = parser.parse_args()
    if min(args.steps, args.functions) < 1:
        raise UserError("--steps and --functions take numbers from 1 on")
    print(describe(compute_device()), flush=True)
    workload = ALL[args.workload].changed(args.gaussians, args.size)
    for parallel in args.parallel if ranks().several else ["tiles"]:
        profile = profiled(workload, parallel, args.steps)
        print(f"\n{workload}, {ranks().size} ranks, {parallel}: {profile.milliseconds:.3f} ms a step")
        print_table(["function", "calls", "us"], profile.rows(args.functions))


if __name__ == "__main__":
    run_cli(main, several=True)
