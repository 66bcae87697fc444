"""Kernels of a training's steps by name, of which some are messages between ranks, or pack and unpack these."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile, record_function

from benchmarks.harness.measuring import short_name
from gaussian_renderer.over_ranks import band
from splatting.part import Part
from splatting.training.iteration import Iteration

_PACKING = "send_splats", "return_rows"  # of gaussian_renderer/over_ranks/exchange.py, as band.py calls them
SUMS = "all kernels", "messages", "packing"
_SHOWN = 0.05  # ms of a kernel


class Kernels(Part):
    """Profiles `count` steps, from the iteration `first` on.

    milliseconds: of a step, by kernel, and of SUMS. A message ends when the slowest rank has sent its part. What packs
    is all that `_PACKING` runs but for the messages, and so the sums of gradient rows, too.
    """

    def __init__(self, first: int, count: int) -> None:
        self._first, self._count = first, count
        on_device = [ProfilerActivity.CUDA] * torch.cuda.is_available()
        self._profile = profile(activities=[ProfilerActivity.CPU, *on_device])
        self._calls = {name: getattr(band, name) for name in _PACKING}
        self.milliseconds: dict[str, float] = {}

    def due(self, at: Iteration) -> bool:
        return False

    def begins(self, at: Iteration) -> None:
        if at.iteration == self._first:
            _wait()
            for name, call in self._calls.items():
                setattr(band, name, record_function(name)(call))
            self._profile.start()

    def stepped(self, at: Iteration) -> None:
        if at.iteration == self._first + self._count - 1:
            _wait()
            self._profile.stop()
            for name, call in self._calls.items():
                setattr(band, name, call)
            self.milliseconds = sums_of(self._profile.events(), self._count)


def sums_of(events: Iterable[Any], steps: int) -> dict[str, float]:
    """Milliseconds of a step, as in `Kernels`, from the profiler's events of so many steps."""
    sums: Counter[str] = Counter(dict.fromkeys(SUMS, 0.0))
    for event in events:
        if event.device_type == DeviceType.CUDA:
            if event.name in _PACKING or event.name.startswith("nccl:"):  # the span of others
                continue
            for name in (short_name(event.name), SUMS[0], *SUMS[1:2] * _is_message(event.name)):
                sums[name] += event.time_range.elapsed_us()
        elif event.name in _PACKING:
            sums[SUMS[2]] += sum(us for name, us in _launched(event) if not _is_message(name))
    return {name: us / 1e3 / steps for name, us in sums.items()}


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _is_message(name: str) -> bool:
    return name.startswith("nccl")


def _launched(event: Any) -> Iterator[tuple[str, float]]:
    """Name and microseconds of each kernel that an event of the host and those within it have launched."""
    yield from ((kernel.name, kernel.duration) for kernel in event.kernels)
    for inner in event.cpu_children:
        yield from _launched(inner)


def kernel_rows(columns: list[dict[str, float]]) -> list[list[str]]:
    """Rows of a table: milliseconds of SUMS and of each kernel, by case, of which each is a column."""
    most = {name: max(column.get(name, 0.0) for column in columns) for column in columns for name in column}
    shown = sorted((name for name in most if most[name] >= _SHOWN and name not in SUMS), key=lambda name: -most[name])
    return [
        [name, *(f"{column[name]:.3f}" if name in column else "" for column in columns)] for name in (*SUMS, *shown)
    ]
