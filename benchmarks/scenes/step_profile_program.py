"""One checkout's part of benchmarks.scenes.step_profile, which runs it as the text of a program.

The arguments are the first iteration, the count, a file for the result, and those of train.py. Trains to the first
iteration, takes `count` iterations by the clock, then as many under torch's profiler, and ends the process.
"""

import json
import os
import sys
import time
from collections import Counter
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from scene.gaussian_model import GaussianModel

WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize", "cudaMemcpy")
LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch",
            "cudaMemcpyAsync", "cudaMemsetAsync")  # fmt: skip


class Probe:
    """Watches the iterations' numbers, which every version announces by its learning rates."""

    def __init__(self, first: int, count: int, result: Path) -> None:
        self._first, self._count, self._result = first, count, result
        self._profile = profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA])
        self._out: dict = {}
        self._latest = 0

    def at(self, iteration: int, gaussians: GaussianModel) -> None:
        if iteration <= self._latest:
            return  # a step that is repeated
        self._latest = iteration
        if iteration == self._first:
            torch.cuda.synchronize()
            self._clock, self._host = time.perf_counter(), time.thread_time()
        elif iteration == self._first + self._count:
            host = time.thread_time()  # without the wait that follows
            torch.cuda.synchronize()
            clock = time.perf_counter()
            self._out |= {"gaussians": len(gaussians.get_xyz), "clock": (clock - self._clock) / self._count}
            self._out["host"] = (host - self._host) / self._count
            self._profile.__enter__()
        elif iteration == self._first + 2 * self._count:
            torch.cuda.synchronize()
            self._profile.__exit__(None, None, None)
            self._out |= {"memory": torch.cuda.max_memory_allocated(), **self._sums()}
            self._result.write_text(json.dumps(self._out))
            sys.stdout.flush()
            os._exit(0)  # what a training does at its end does not belong here

    def _sums(self) -> dict:
        kernels, counts, calls = Counter(), Counter(), Counter()
        for event in self._profile.events():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                kernels[event.name] += event.time_range.elapsed_us() / self._count
                counts[event.name] += 1 / self._count
            elif event.name.startswith("cu"):
                calls[event.name] += 1 / self._count
        launches, waits = (sum(calls[name] for name in names) for names in (LAUNCHES, WAITS))
        return {"kernels": kernels, "counts": counts, "launches": launches, "waits": waits}


def main() -> None:
    first, count, result, *options = sys.argv[1:]
    probe, announce = Probe(int(first), int(count), Path(result)), GaussianModel.update_learning_rate

    def update(self: GaussianModel, iteration: int):
        probe.at(iteration, self)
        return announce(self, iteration)

    GaussianModel.update_learning_rate = update
    import train

    train.main(options)
