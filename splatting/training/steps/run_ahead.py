"""The host runs ahead of a GPU: it gives lists room by guess, and repeats what lacked room.

A step needs memory for lists whose lengths only the GPU knows. To wait for them in every step would leave the GPU idle
while the host prepares the next launches. So the host guesses from what the view needed before, and does not wait. A
kernel that finds too little room halts: neither it nor any later kernel changes anything (gs::Queue::halted in
submodules/common/include/gs/cuda_queue.h). Some steps later the host reads that in a report which the GPU writes into
the host's memory. It then makes room, and repeats the steps from the halted one on, in their order. So no value depends
on the guesses, only the time does. The GPU counts the steps itself, so that a step can be recorded
(splatting/training/steps/recorded.py).

Streams: everything that a step computes is queued on torch's current stream, in the order of the calls. Photos that
the CPU keeps are copied on a stream of their own, and the current stream waits for the event of the one it needs
(scene/images/device_copies.py). A step is recorded on a third stream, on which nothing ever runs; its launch is
queued on the current stream like any other. The reports go straight into page-locked memory. The host reads them
without a call to the GPU, and waits for the whole stream before it repeats steps or lets anybody read the model.
"""

import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from diff_gaussian_rasterization.backend import OPERATORS

AHEAD = 8  # steps; enough to hide a pause of the host, and few to repeat
_REPORTS = 2 * AHEAD
_SPARE = 1.25  # of room for what a view needed before: Gaussians move and multiply until its next visit
_LEAST = 1024
_MOST = 2**31 - 1
_NAP = 1e-4  # seconds; steps of less than this are queued in numbers anyway

Room = tuple[int, int, int]  # of instances, slots and gradient rows (gs::Room)


@dataclass
class _Pending:
    view: Hashable
    repeat: Callable[[], None]
    refuse: Callable[[], None]
    counted: bool = True  # whether the host counts the step among those that it has queued


class RunAhead:
    """Runs steps ahead of a GPU.

    first: the room of the first step. rewind: called with a number of steps before these are repeated, to take back
    what the host counted for them.
    """

    def __init__(self, device: torch.device, first: Room, rewind: Callable[[int], None]) -> None:
        self._words = torch.zeros(5, dtype=torch.int64, device=device)
        self._reports = torch.zeros(_REPORTS, 5, dtype=torch.int64, pin_memory=True)
        self._numbers = list(self._reports.numpy())  # the same memory
        self._stream = torch.cuda.current_stream(device)
        self._first, self._needed = first, {}
        self._pending: deque[_Pending] = deque()
        self._rewind = rewind
        self._done = 0  # steps, as far as the host knows
        self.halts = 0  # so far

    def take(
        self, view: Hashable, step: Callable[[], bool], repeat: Callable[[], None], refuse: Callable[[], None]
    ) -> bool:
        """Take note of a step that `step` queues, with what `room` gives. Returns whether it did queue it, as it says.

        repeat: queues it once more, with the same values. refuse: renders the view so that the host waits, which raises
        an error if its lists are too long for any room.
        """
        if step():
            self._pending.append(_Pending(view, repeat, refuse))
            return True
        self._collect(0)
        self._stream.synchronize()
        self._words[0] = 0  # what was queued in vain may have lacked room
        self._done = int(self._words[4])
        return False

    def make_way(self) -> None:
        """Wait until another step can be queued."""
        self._collect(AHEAD - 1)

    def settle(self) -> None:
        """Wait until all steps are done."""
        self._collect(0)

    def give_up(self) -> int:
        """Drop the steps that lack room, after an error. Returns their number; they changed nothing."""
        self._stream.synchronize()
        while self._pending and (report := self._report()) and not report[3]:
            self._finish(report)
        lost = len(self._pending)
        self._rewind(sum(pending.counted for pending in self._pending))
        self._pending.clear()
        return lost

    @contextmanager
    def room(self, view: Hashable | None) -> Iterator[None]:
        """Within it, operators take room for what a view needed before, or with None for what any view needed."""
        OPERATORS.run_ahead_(self._words, self._room_of(view), self._reports)
        try:
            yield
        finally:
            OPERATORS.run_ahead_(None, [], None)

    def _room_of(self, view: Hashable | None) -> Room:
        """Room for what a view needed before; a new view gets room for the largest."""
        if not self._needed:
            return self._first
        needed = self._needed.get(view) or tuple(map(max, zip(*self._needed.values(), strict=True)))
        instances, slots, rows = map(_with_spare, needed)
        return min(instances, _MOST), slots, min(rows, _MOST)

    def _report(self) -> list[int] | None:
        """Of the first pending step: instances, slots, rows, halted; None until the GPU has written them."""
        number = self._done + 1
        numbers = self._numbers[number % _REPORTS]
        return numbers[:4].tolist() if numbers[4] == number else None

    def _finish(self, report: list[int]) -> None:
        """Strike the first pending step off."""
        self._needed[self._pending.popleft().view] = tuple(report[:3])
        self._done += 1

    def _collect(self, most: int) -> None:
        """Take back the reports that are there, and wait until at most so many steps are pending."""
        while self._pending:
            report = self._report()
            if report is None:
                if len(self._pending) <= most:
                    return
                time.sleep(_NAP)
            elif report[3]:
                self._repeat(report)
            else:
                self._finish(report)

    def _repeat(self, report: list[int]) -> None:
        """Make room for the step that was halted, and repeat it and all later ones."""
        self.halts += 1
        self._stream.synchronize()
        self._words[0] = 0
        self._numbers[(self._done + 1) % _REPORTS][4] = 0  # the halted step's report will come once more
        self._rewind(len(self._pending))
        for pending in self._pending:
            pending.counted = False
        instances, slots, rows, _ = report
        if instances > _MOST:
            self._pending[0].refuse()
        # A step without room for instances did not count its rows, of which there are no more.
        self._needed[self._pending[0].view] = instances, slots, rows or instances
        for pending in self._pending:
            pending.repeat()
            pending.counted = True


def _with_spare(count: int) -> int:
    """Room for a little more, in few different sizes, so that torch's allocator finds them again."""
    wanted = max(int(_SPARE * count), _LEAST)
    unit = 1 << max(wanted.bit_length() - 4, 0)
    return -(-wanted // unit) * unit
