"""Speculative list capacities: a host that runs ahead of its GPU replays the steps that overflow.

A step needs memory for lists whose lengths only the GPU knows. To wait for the lengths in every step would leave the
GPU idle while the host prepares the next launches. So the host guesses from what the view needed before, and does not
wait. A kernel that finds too little capacity halts: neither it nor any later kernel changes anything (gs::Queue::halted
in submodules/common/include/gs/cuda_queue.h). Some steps later the host reads of the halt in a report that the GPU
writes into the host's memory. It then raises the capacity, and replays the steps from the halted one on, in their
order. So no value depends on the guesses, only the time does. The GPU counts the steps itself, so that a step can be
captured.

Streams: everything that a step computes is queued on torch's current stream, in the order of the calls. Photos that the
    CPU keeps are copied on a stream of their own, and the current stream waits for the event of the one it needs
    (scene/images/store.py). A step is captured on a third stream, on which nothing ever runs; its launch is queued on
    the current stream like any other. The reports go straight into page-locked memory. The host reads them without a
    call to the GPU, and waits for the whole stream before it replays steps or lets anybody read the model.
"""

import time
from collections import deque
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from diff_gaussian_rasterization.backend import OPERATORS

from splatting.iteration import Iteration, Losses

AHEAD = 8  # steps; enough to hide a pause of the host, and few to replay


class Replayed(Protocol):
    """Interface by which speculation replays the steps of their owner (splatting/faster/captured.py)."""

    def measure(self, at: Iteration) -> object:
        """Render a view, and compute the losses and their gradients."""

    def replay(self, at: Iteration, first: Losses) -> None:
        """Take a step once more, and copy its losses into `first`."""

    def rewind(self, steps: int) -> None:
        """Take back the counts of the host for so many steps."""


_REPORTS = 2 * AHEAD
_SPARE = 1.25  # times what a view needed before: Gaussians move and multiply until its next visit
_LEAST = 1024
_LEAST_BLOCKS = 16
_MOST = 2**31 - 1
_FIRST = 1 << 20, 1 << 20, 1 << 20, 1 << 13  # capacity of the first step: more costs much memory, less a replay
_NAP = 1e-4  # seconds; steps of less than this are queued in numbers anyway

Capacity = tuple[int, int, int, int]  # of instances, slots, gradient rows and blocks that are awake (gs::Room)


@dataclass
class _Pending:
    at: Iteration
    losses: Losses


class Speculation:
    """The steps that a GPU has yet to do.

    steps: owner of the steps, which queues and replays them.
    """

    def __init__(self, device: torch.device, steps: "Replayed") -> None:
        """Allocate the words in which the GPU counts, and the page-locked rows for its reports."""
        self._words = torch.zeros(6, dtype=torch.int64, device=device)
        self._reports = torch.zeros(_REPORTS, 6, dtype=torch.int64, pin_memory=True)
        self._numbers = list(self._reports.numpy())  # the same memory
        self._stream = torch.cuda.current_stream(device)
        self._steps = steps
        self._needed: dict[Hashable, Capacity] = {}
        self._pending: deque[_Pending] = deque()
        self._done = 0  # steps, as far as the host knows

    def add(self, at: Iteration, losses: Losses) -> None:
        """Take note of a step that was queued with its `capacity`."""
        self._pending.append(_Pending(at, losses))

    def discard(self) -> None:
        """Forget the launches of a step that is taken in another way, once all steps before it are done."""
        self._collect(0)
        self._stream.synchronize()
        self._words[0] = 0  # what was queued in vain may have overflowed
        self._done = int(self._words[5])

    def throttle(self) -> None:
        """Wait until another step can be queued."""
        self._collect(AHEAD - 1)

    def wait(self, most: int) -> None:
        """Wait until at most so many steps are pending."""
        self._collect(most)

    def drain(self) -> None:
        """Wait until all steps are done."""
        self._collect(0)

    def abort(self) -> None:
        """Wait, after an error, until the GPU writes no more into memory that is given back."""
        self._stream.synchronize()

    @contextmanager
    def capacity(self, at: Iteration | None) -> Iterator[None]:
        """Give operators the capacity that an iteration's view needed before, or with None the largest of any view."""
        OPERATORS.run_ahead_(self._words, self._choose_capacity(at and _view_key(at)), self._reports)
        try:
            yield
        finally:
            OPERATORS.run_ahead_(None, [], None)

    def _choose_capacity(self, view: Hashable | None) -> Capacity:
        """Return the capacity that a view needed before, with some spare; a new view gets that of the largest."""
        if not self._needed:
            return _FIRST
        *lists, blocks = self._find_needs(view)
        instances, slots, rows = map(_add_spare, lists)
        return min(instances, _MOST), slots, min(rows, _MOST), _add_spare(blocks, _LEAST_BLOCKS)

    def _find_needs(self, view: Hashable | None) -> Capacity:
        return self._needed.get(view) or tuple(map(max, zip((0, 0, 0, 0), *self._needed.values(), strict=True)))

    def _report(self) -> list[int] | None:
        """Return the report of the first pending step: its needs, then halted; None until the GPU has written it."""
        number = self._done + 1
        numbers = self._numbers[number % _REPORTS]
        return numbers[:5].tolist() if numbers[5] == number else None

    def _finish(self, report: list[int]) -> None:
        """Take the first pending step off the list, and note its needs."""
        at = self._pending.popleft().at
        self._needed[_view_key(at)] = tuple(report[:4])
        self._done += 1

    def _collect(self, most: int) -> None:
        """Read the reports that are there, and wait until at most so many steps are pending."""
        while self._pending:
            report = self._report()
            if report is None:
                if len(self._pending) <= most:
                    return
                time.sleep(_NAP)
            elif report[4]:
                self._replay(report)
            else:
                self._finish(report)

    def _replay(self, report: list[int]) -> None:
        """Raise the capacity of the step that was halted, and replay this step and all later ones."""
        self._stream.synchronize()
        self._words[0] = 0
        self._numbers[(self._done + 1) % _REPORTS][5] = 0  # the halted step's report will come once more
        self._steps.rewind(len(self._pending))
        instances, slots, rows, blocks, _ = report
        if instances > _MOST:
            self._steps.measure(self._pending[0].at)  # raises an error: its lists are too long for any capacity
        view = _view_key(self._pending[0].at)
        if not instances:  # it overflowed with blocks, and counted nothing else
            instances, slots, rows, _ = self._find_needs(view) if self._needed else _FIRST
        # A step that overflowed with instances did not count its rows, of which there are no more.
        self._needed[view] = instances, slots, rows or instances, blocks
        for pending in self._pending:
            self._steps.replay(pending.at, pending.losses)


def _add_spare(count: int, least: int = _LEAST) -> int:
    """Return a little more than a count, in few different sizes, so that torch's allocator finds them again."""
    requested = max(int(_SPARE * count), least)
    unit = 1 << max(requested.bit_length() - 4, 0)
    return -(-requested // unit) * unit


def _view_key(at: Iteration) -> Hashable:
    """Return the key of the view on which the capacity of a step depends."""
    return at.camera.uid, at.camera.image_width
