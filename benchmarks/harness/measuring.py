"""Head and form of tables, and run time and memory of a call on the CPU and on a GPU."""

import argparse
import re
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from groundwork.host.listing import markdown_table
from groundwork.host.machine import facts, one_line
from utils.system_utils import UserError, compute_device


def describe_machine(device: torch.device | str = "cpu") -> str:
    """Return one line with processor or GPU, threads, instruction set, versions and commit."""
    found = facts(device)
    return one_line(found) + (f", CUDA {found['cuda']}" if found["cuda"] else "")


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print a Markdown table with every column aligned to the left."""
    print(markdown_table(header, rows, right=False).rstrip("\n"), flush=True)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add --device, which `choose_device` reads."""
    parser.add_argument("--device", choices=["cpu", "cuda"], help="default: cuda if there is a GPU and CUDA kernels")


def choose_device(args: argparse.Namespace) -> str:
    """Return "cpu" or "cuda"; UserError if a GPU is asked for and none can be used."""
    found = compute_device().type
    if args.device == "cuda" and found != "cuda":
        raise UserError("--device cuda needs a visible GPU and the rasterizer built with CUDA (GS_CUDA=1)")
    return args.device or found


WARM_UPS, REPEATS = 20, 50  # on a GPU
_PROFILED = 10  # calls


@dataclass
class GpuTime:
    """Median milliseconds of a call that starts on an idle device."""

    events: float  # between CUDA events around the call; includes gaps in which the device waits for the host
    launched: list[tuple[str, float]]  # name and milliseconds of each kernel in order; copies and fills count, too

    @property
    def kernels(self) -> float:
        """Milliseconds in which the device runs kernels."""
        return sum(milliseconds for _, milliseconds in self.launched)


def cpu_milliseconds(run: Callable[[], object], repeats: int) -> float:
    """Return the median wall time of a call, after a warm-up call."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def gpu_milliseconds(run: Callable[[], object]) -> float:
    """Return the median time of REPEATS calls after WARM_UPS by events, each on an idle device."""
    times = []
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    for _ in range(WARM_UPS + REPEATS):
        torch.cuda.synchronize()
        begin.record()
        run()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return statistics.median(times[WARM_UPS:])


def gpu_time(run: Callable[[], object]) -> GpuTime:
    """Return the median over REPEATS calls after WARM_UPS calls, and the kernels of a call, means over some calls."""
    events = gpu_milliseconds(run)
    calls = [list_launches(run) for _ in range(_PROFILED)]
    same = [call for call in calls if [name for name, _ in call] == [name for name, _ in calls[0]]]
    means = [(of[0][0], statistics.mean(ms for _, ms in of)) for of in zip(*same, strict=True)]
    return GpuTime(events, means)


def list_launches(run: Callable[[], object]) -> list[tuple[str, float]]:
    """Return name and milliseconds of each kernel that a call runs on the device, in order."""
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as trace:
        run()
        torch.cuda.synchronize()
    on_device = [event for event in trace.events() if event.device_type == DeviceType.CUDA]
    on_device.sort(key=lambda event: event.time_range.start)
    return [(shorten_name(event.name), event.time_range.elapsed_us() / 1e3) for event in on_device]


def measure_peak_mib(run: Callable[[], object], clear: Callable[[], None]) -> float:
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


def shorten_name(name: str) -> str:
    """Strip return type, namespaces, template arguments and parameters from a kernel's name."""
    if name.startswith(("Memcpy", "Memset")):
        return name.split(" (")[0]
    name = name.replace("(anonymous namespace)", "")
    while (bare := re.sub(r"<[^<>]*>", "", name)) != name:
        name = bare
    return name.split("(")[0].split("::")[-1].split(" ")[-1]
