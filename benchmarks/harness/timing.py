"""Run time and memory of a call, on the CPU and on a GPU."""

import re
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.autograd import DeviceType
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile

WARM_UPS, REPEATS = 20, 50  # on a GPU
_PROFILED = 10  # calls
_WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaMemcpy")


@dataclass
class Kernel:
    """Consecutive launches of one kernel; copies and fills count as kernels."""

    name: str
    launches: int
    milliseconds: float


@dataclass
class GpuTime:
    """Median milliseconds of a call that starts on an idle device."""

    events: float  # between CUDA events around the call; includes gaps in which the device waits for the host
    wall: float  # by the host's clock, until the device is done
    launched: list[Kernel]  # in order
    waits: int  # times that the host waits for the device within the call

    @property
    def kernels(self) -> float:
        """Milliseconds in which the device runs kernels."""
        return sum(kernel.milliseconds for kernel in self.launched)


def cpu_milliseconds(run: Callable[[], object], repeats: int) -> float:
    """Return the median wall time of a call, after a warm-up call."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def gpu_time(run: Callable[[], object]) -> GpuTime:
    """Return medians over REPEATS calls after WARM_UPS calls."""
    for _ in range(WARM_UPS):
        run()
    events, walls = [], []
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    for _ in range(REPEATS):
        torch.cuda.synchronize()
        start = time.perf_counter()
        begin.record()
        run()
        end.record()
        torch.cuda.synchronize()
        walls.append(1e3 * (time.perf_counter() - start))
        events.append(begin.elapsed_time(end))
    launched, waits = _profile(run, _PROFILED) or _profile(run, 1)
    return GpuTime(statistics.median(events), statistics.median(walls), launched, waits)


def _profile(run: Callable[[], object], calls: int) -> tuple[list[Kernel], int] | None:
    """Return kernels, with mean times, and waits of a call; None if the calls launched different kernels."""

    def several() -> None:
        for _ in range(calls):
            run()

    events = _events(several)
    launched = _launched(events)
    per_call = len(launched) // calls
    names = [name for name, _ in launched[:per_call]]
    if [name for name, _ in launched] != names * calls:
        return None
    result: list[Kernel] = []
    for i, name in enumerate(names):
        milliseconds = statistics.mean(ms for _, ms in launched[i::per_call])
        if result and result[-1].name == name:
            result[-1].launches += 1
            result[-1].milliseconds += milliseconds
        else:
            result.append(Kernel(name, 1, milliseconds))
    return result, sum(e.name in _WAITS for e in events) // calls


def launches(run: Callable[[], object]) -> list[tuple[str, float]]:
    """Return name and milliseconds of each kernel that a call runs on the device, in order."""
    return _launched(_events(run))


def _events(run: Callable[[], object]) -> list[FunctionEvent]:
    """Return the profiler's events of a call, in order."""
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as trace:
        run()
        torch.cuda.synchronize()
    return sorted(trace.events(), key=lambda e: e.time_range.start)


def _launched(events: list[FunctionEvent]) -> list[tuple[str, float]]:
    on_device = (e for e in events if e.device_type == DeviceType.CUDA)
    return [(short_name(e.name), e.time_range.elapsed_us() / 1e3) for e in on_device]


def peak_mib(run: Callable[[], object], clear: Callable[[], None]) -> float:
    """Return the peak GPU memory of a call above what was in use before it, MiB; `clear` drops the gradients."""
    run()
    clear()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    torch.cuda.synchronize()
    peak = torch.cuda.max_memory_allocated() - before
    clear()
    return peak / 2**20


def short_name(name: str) -> str:
    """Strip return type, namespaces, template arguments and parameters from a kernel's name."""
    if name.startswith(("Memcpy", "Memset")):
        return name.split(" (")[0]
    name = name.replace("(anonymous namespace)", "")
    while (bare := re.sub(r"<[^<>]*>", "", name)) != name:
        name = bare
    return name.split("(")[0].split("::")[-1].split(" ")[-1]
