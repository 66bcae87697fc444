"""The pace of a run: which iterations of its schedule each of its iterations stands for.

Options count iterations of a schedule, whose last is --iterations: windows of densification, resets, learning rates,
and when to test or save. A steady run takes each of them once. A paced run is longer or shorter, and still goes
through the whole schedule.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

USUAL = 30_000  # iterations that the default learning rates are for
LONGER = 2.0  # times the root of the stride
MOST_RATE = 8.0  # about the best for 1,300 iterations in place of 30,000 (docs/results/tried.md)
SETTLING = 0.7  # part of the schedule from which on steps get shorter
LEAST_RATE = 0.1  # part of a rate that is left at the end
Levels = Sequence[tuple[float, float]]  # part of the schedule that is done (0 to 1), and factor of sizes from then on

PYRAMID: Levels = ((0.0, 4.0), (0.1, 2.0), (0.25, 1.0))
_ROUNDING = 1e-6  # iterations of the schedule; progress is a float, and just below a whole number counts as that


class Pace:
    """The steady pace: each iteration stands for itself.

    length: of the schedule, in iterations. ends: the last iteration of the run, None: not known yet. views: of each
    iteration. sizes: the schedule of the views' sizes that is in force (--resolution_schedule); levels: of that.
    """

    views = 1
    sizes = "none"
    levels: Levels = ()

    def __init__(self, length: int) -> None:
        self.length = length
        self.ends: int | None = length

    def reach(self, iteration: int, seconds: float) -> None:
        """Decide how to go on, before an iteration that begins after `seconds` of training. Call it for each."""

    def nominal(self, iteration: int) -> int:
        """How far the schedule is in an iteration that was reached, 0 to `length`."""
        return iteration

    def span(self, iteration: int) -> range:
        """Iterations of the schedule that an iteration stands for; none where the run is slower than its schedule.

        The stop is one more than `nominal`.
        """
        return range(self.nominal(iteration - 1) + 1, self.nominal(iteration) + 1)

    def stride(self, iteration: int) -> float:
        """Iterations of the schedule that one of the run stands for, at that place."""
        return 1.0

    def rate_factor(self, iteration: int) -> float | None:
        """Factor of the learning rates that have no schedule. None: they are left as they are."""
        return None

    def is_last(self, iteration: int) -> bool:
        """Whether a run that is not stopped ends with this iteration."""
        return iteration == self.ends

    def is_over(self, iteration: int) -> bool:
        """Whether nothing is left to do after an iteration."""
        return self.ends is not None and iteration >= self.ends

    def known(self, planned: Sequence[int]) -> list[int]:
        """Iterations of the run that will take those of the schedule that are planned, as far as it is known."""
        return [iteration for iteration in planned if iteration <= self.length]


STEADY = Pace(0)  # of no length, for those who only ask what an iteration stands for


class Settling(Pace):
    """The steady pace with learning rates that follow the number of iterations, and fall at the end."""

    def rate_factor(self, iteration: int) -> float:
        return longer_steps(USUAL / self.length, iteration / self.length)


def longer_steps(stride: float, progress: float) -> float:
    """Factor of learning rates where an iteration stands for `stride` of the USUAL ones.

    Few steps have to be longer ones: LONGER times the root of `stride`, at most MOST_RATE and at least 1. Towards the
    end all get shorter, smoothly, down to LEAST_RATE of that, so that the Gaussians settle. progress: part of the
    schedule that is done, 0 to 1.
    """
    longer = max(min(LONGER * math.sqrt(stride), MOST_RATE), 1.0)
    late = min(max(progress - SETTLING, 0.0) / (1.0 - SETTLING), 1.0)
    return longer * (1.0 - (1.0 - LEAST_RATE) * late * late * (3.0 - 2.0 * late))


class Block(NamedTuple):
    """Iterations that go through the schedule at one pace, from the one after the block before to `last`."""

    last: int
    start: float  # part of the schedule that is done before the block, 0 to 1
    step: float  # part of the schedule that each iteration does
    seconds: float  # of training before the block


class Schedule(NamedTuple):
    """What a run decided, as schedule.json keeps it (splatting/training/schedule/schedule_file.py)."""

    iterations: int  # of its schedule
    blocks: list[Block]
    ended: int | None  # the last iteration, None if the run has not ended
    time_budget: float  # seconds
    resolution_schedule: str = "none"
    levels: Levels = ()


class Paced(Pace):
    """A pace that is given: that of a recorded schedule."""

    def __init__(self, schedule: Schedule) -> None:
        super().__init__(schedule.iterations)
        self.schedule = schedule
        self.blocks = list(schedule.blocks)
        self.ends = schedule.ended
        self.sizes, self.levels = schedule.resolution_schedule, schedule.levels

    def progress(self, iteration: int) -> float:
        """Part of the schedule that is done after an iteration, 0 to 1."""
        if iteration <= 0:
            return 0.0
        index, block = self._block(iteration)
        return block.start + block.step * (iteration - self._last(index))

    def nominal(self, iteration: int) -> int:
        if iteration <= 0:
            return 0
        # The end of the schedule is only reached in the last iteration.
        most = self.length if self.is_last(iteration) else self.length - 1
        return min(int(self.length * self.progress(iteration) + _ROUNDING), most)

    def stride(self, iteration: int) -> float:
        return self._block(iteration)[1].step * self.length

    def rate_factor(self, iteration: int) -> float:
        return longer_steps(USUAL * self._block(iteration)[1].step, self.progress(iteration))

    def known(self, planned: Sequence[int]) -> list[int]:
        return [self.ends] if self.ends is not None and self.length in planned else []

    def recorded(self, iteration: int, last: bool) -> Schedule:
        """The schedule of a run that has taken an iteration. last: it ended with it."""
        if last:
            return self.up_to(iteration)._replace(ended=iteration)
        return self.schedule

    def up_to(self, iteration: int) -> Schedule:
        """The schedule of a run that went no further than an iteration."""
        index, block = self._block(iteration)
        blocks = [*self.blocks[:index], block._replace(last=iteration)]
        return self.schedule._replace(blocks=blocks, ended=None, resolution_schedule=self.sizes, levels=self.levels)

    def _block(self, iteration: int) -> tuple[int, Block]:
        index = bisect_left(self.blocks, iteration, key=lambda block: block.last)
        return index, self.blocks[index]

    def _last(self, index: int) -> int:
        """The iteration before a block."""
        return self.blocks[index - 1].last if index else 0
