"""The schedule of a run: maps its iterations to steps of the schedule, so that a run may be of any length.

Options count steps of a schedule, whose last is --iterations: windows of densification, resets, learning rates, and
when to test or save. A steady run takes each of them in one iteration. Another run is longer or shorter, and still goes
through the whole schedule: by the clock (--time_budget), or as a file says (--schedule).
"""

import math
import statistics
import sys
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import NamedTuple

from tqdm import tqdm

USUAL = 30_000  # iterations that the default learning rates are for
LONGER = 2.0  # times the root of the stride
MOST_RATE = 8.0  # about the best for 1,300 iterations in place of 30,000 (docs/results/tried.md)
_PACE = 5  # blocks that tell the pace of a run
SETTLING = 0.7  # part of the schedule from which on steps get shorter
LEAST_RATE = 0.1  # part of a rate that is left at the end
Levels = Sequence[tuple[float, float]]  # part of the schedule that is done (0 to 1), and factor of sizes from then on

PYRAMID: Levels = ((0.0, 4.0), (0.1, 2.0), (0.25, 1.0))
_ROUNDING = 1e-6  # iterations of the schedule; progress is a float, and just below a whole number counts as that
PART = 1 / 200  # of the budget that a block takes, so that what is left is known well before the end
_MOST_GROWTH = 2  # of a block over the one before, while the first iterations are slower than the others
_KNOWN = 1 / 50  # of the budget, after which the speed says how many iterations there may be
SHORT = 4.0  # megapixels of the schedule for each iteration, from which on it pays to begin with smaller views
_LAST = 1.5  # blocks; if no more are left, they are one
_MOST_SHARE = 2  # times the part of the schedule that an iteration does where no seconds are lost
_TOLD = 1.02  # times the budget, from which on a run says that it takes longer


class Schedule:
    """The steady schedule: each iteration stands for itself.

    length: of the schedule, in iterations. ends: the last iteration of the run, None: not known yet. megapixels: of a
    view. sizes: the schedule of the views' sizes that is in force (--resolution_schedule); levels: of that. strategy:
    the one in force (--strategy).
    """

    megapixels = 1.0
    sizes = "none"
    levels: Levels = ()
    strategy = ""

    def __init__(self, length: int) -> None:
        self.length = length
        self.ends: int | None = length

    @property
    def expected(self) -> float | None:
        """The number of iterations of the run, as far as it can be told; None: not yet."""
        return self.ends

    def reach(self, iteration: int, seconds: float) -> None:
        """Decide the part of the next iterations, before one that begins after `seconds` of training. Call for each."""

    def schedule_step(self, iteration: int) -> int:
        """How far the schedule is in an iteration that was reached, 0 to `length`."""
        return iteration

    def span(self, iteration: int) -> range:
        """Iterations of the schedule that an iteration stands for; none where the run is slower than its schedule.

        The stop is one more than `schedule_step`.
        """
        return range(self.schedule_step(iteration - 1) + 1, self.schedule_step(iteration) + 1)

    def stride(self, iteration: int) -> float:
        """Iterations of the schedule that one of the run stands for, at that place."""
        return 1.0

    def factor_at(self, schedule_step: float) -> float:
        """Factor of the views' sizes at an iteration of the schedule."""
        index = bisect_right(self.levels, schedule_step, key=lambda level: level[0] * self.length) - 1
        return self.levels[index][1] if index >= 0 else 1.0

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


STEADY = Schedule(0)  # of no length, for those who only ask what an iteration stands for


class SettlingSchedule(Schedule):
    """The steady schedule with learning rates that follow the number of iterations, and fall at the end."""

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
    """Iterations that each do as much of the schedule, from the one after the block before to `last`."""

    last: int
    start: float  # part of the schedule that is done before the block, 0 to 1
    step: float  # part of the schedule that each iteration does
    seconds: float  # of training before the block


class Decided(NamedTuple):
    """What a run decided, as schedule.json and checkpoints keep it (splatting/training/schedule_file.py)."""

    iterations: int  # of its schedule
    blocks: list[Block]
    ended: int | None  # the last iteration, None if the run has not ended
    time_budget: float  # seconds
    resolution_schedule: str = "none"
    levels: Levels = ()
    strategy: str = ""  # that trained; empty in files of older versions


class DecidedSchedule(Schedule):
    """A schedule that was decided by an earlier run."""

    def __init__(self, decided: Decided) -> None:
        super().__init__(decided.iterations)
        self._decided = decided
        self.blocks = list(decided.blocks)
        self.ends = decided.ended
        self.sizes, self.levels, self.strategy = decided.resolution_schedule, decided.levels, decided.strategy
        self.seconds = decided.time_budget

    def progress(self, iteration: int) -> float:
        """Part of the schedule that is done after an iteration, 0 to 1."""
        if iteration <= 0:
            return 0.0
        index, block = self._block(iteration)
        return block.start + block.step * (iteration - self._last(index))

    def schedule_step(self, iteration: int) -> int:
        if iteration <= 0:
            return 0
        # The end of the schedule is only reached in the last iteration.
        most = self.length if self.is_last(iteration) else self.length - 1
        return min(int(self.length * self.progress(iteration) + _ROUNDING), most)

    def stride(self, iteration: int) -> float:
        return self._block(iteration)[1].step * self.length

    def possible(self, iteration: int) -> float:
        """Iterations that fit into the budget at the pace of its end, as far as a block before this iteration tells it.

        Smaller views at first say nothing of that pace. Where no block has it, iterations at the present stride.
        """
        index, present = self._block(iteration)
        spans = zip([0, *(block.last for block in self.blocks)], self.blocks[:index], self.blocks[1:], strict=False)
        speeds = [
            (after.seconds - block.seconds) / (block.last - before)
            for before, block, after in spans
            if self.factor_at(self.length * (block.start + block.step)) == 1
        ]
        speed = statistics.median(speeds[-_PACE:]) if speeds else 0.0
        return self.seconds / speed if speed > 0 else 1 / present.step

    def rate_factor(self, iteration: int) -> float:
        return longer_steps(USUAL * self._block(iteration)[1].step, self.progress(iteration))

    def known(self, planned: Sequence[int]) -> list[int]:
        return [self.ends] if self.ends is not None and self.length in planned else []

    @property
    def decided(self) -> Decided:
        """All that is decided by now, also of iterations to come."""
        decided = {"resolution_schedule": self.sizes, "levels": self.levels, "strategy": self.strategy}
        return self._decided._replace(blocks=self.blocks, ended=self.ends, **decided)

    def up_to(self, iteration: int) -> Decided:
        """The schedule of a run that went no further than an iteration."""
        index, block = self._block(iteration)
        blocks = [*self.blocks[:index], block._replace(last=iteration)]
        return self.decided._replace(blocks=blocks, ended=iteration if self.is_last(iteration) else None)

    def _block(self, iteration: int) -> tuple[int, Block]:
        index = bisect_left(self.blocks, iteration, key=lambda block: block.last)
        return index, self.blocks[index]

    def _last(self, index: int) -> int:
        """The iteration before a block."""
        return self.blocks[index - 1].last if index else 0


class TimeBudget(DecidedSchedule):
    """Goes through the schedule as the seconds of training pass, and ends with them.

    A block of iterations does as large a part of what is left of the schedule as it will take of the seconds that are
    left, at the speed of the blocks before it. So seconds that were lost, by a slow start or by another program, are
    taken from all that is left. Where so many were lost that iterations would do more than _MOST_SHARE times their
    usual part, the run takes longer than its budget. Seconds are those of training, with those of the runs that this
    one resumes, whose blocks are in the schedule. share: gives all processes the seconds of one.
    """

    def __init__(self, decided: Decided, share: Callable[[float], float] = lambda seconds: seconds) -> None:
        super().__init__(decided)
        self._share = share
        self._open = self.sizes != "none" and not self.levels
        self._asked = self.sizes == "pyramid"
        self.sizes = "none" if self.sizes == "auto" else self.sizes
        self._speed: float | None = None  # seconds of an iteration
        self._speeds: list[float] = []  # of the last three blocks
        self._measured = 0  # blocks of this run
        self._first = self.blocks[-1].last if self.blocks else 0
        self._told = False
        self._expected: float | None = None

    @property
    def expected(self) -> float | None:
        return self._expected if self.ends is None else float(self.ends)

    def reach(self, iteration: int, seconds: float) -> None:
        if not self.blocks or iteration > self.blocks[-1].last:
            seconds = self._share(seconds)
            self._measure(seconds)
            if self._open and self._measured > 2 and seconds > _KNOWN * self.seconds:
                self._choose_sizes(iteration - 1, seconds)
            self._decide(seconds)

    def _measure(self, seconds: float) -> None:
        """Take the speed of the block that is done, if this run has taken it."""
        if not self.blocks or self.blocks[-1].last == self._first:
            return
        block, before = self.blocks[-1], self._last(len(self.blocks) - 1)
        speed = max(seconds - block.seconds, 1e-9) / (block.last - before)
        self._measured += 1
        # The first iteration loads kernels and photos, so it is no measure of the others.
        self._speed = speed if self._measured <= 2 else (self._speed + speed) / 2
        if self._measured > 1:
            self._speeds = [*self._speeds[-2:], speed]

    def _choose_sizes(self, done: int, seconds: float) -> None:
        """Take smaller views if asked to, or if few pixels can be trained: from the next one on, as is recorded.

        The first views are never smaller, as they tell the pace of the end.
        """
        self._open = False
        now = (self.schedule_step(done) + 0.5) / self.length
        possible = done + max(self.seconds - seconds, 0.0) / self._speed
        short = self.megapixels * self.length / possible >= SHORT and now < PYRAMID[1][0]
        if short or self._asked:
            self.sizes = "pyramid"
            begun = [factor for start, factor in PYRAMID if start <= now][-1]
            self.levels = ((now, begun), *(level for level in PYRAMID if level[0] > now))

    def _decide(self, seconds: float) -> None:
        """Add the block that comes next."""
        before = self.blocks[-1].last if self.blocks else 0
        done = self.progress(before)
        iterations = self._iterations(seconds, 1.0 - done)
        self._expected = before + iterations if self._speeds else None
        count, final = self._count(iterations)
        if final:
            step = (1.0 - done) / count
            self.ends = before + count
        elif self._speed is None:
            step = min(1.0 / self.length, (1.0 - done) / 2)
        else:
            step = (1.0 - done) * min(1.0 / iterations, 0.5 / count)
        self.blocks.append(Block(before + count, done, step, round(seconds, 6)))
        if final and self._measured <= 1:
            tqdm.write(
                f"warning: --time_budget {self.seconds:g} is too short for {self.ends + 1} iterations, so training "
                f"ends with iteration {self.ends}; give more seconds, or lower --resolution (-r)",
                file=sys.stderr,
            )

    def _iterations(self, seconds: float, undone: float) -> float:
        """Iterations that the run has yet to take, infinite where no speed is known. undone: part of the schedule."""
        left = max(self.seconds - seconds, 0.0)
        if self._speed is None:
            return math.inf if left else 0.0
        if not self._speeds:
            return left / self._speed
        if not self._told and seconds + undone * self.seconds / _MOST_SHARE > _TOLD * self.seconds:
            self._told = True
            tqdm.write(
                "warning: some iterations took so long that the training needs about "
                f"{seconds + undone * self.seconds / _MOST_SHARE:.0f} s, not the {self.seconds:g} s of --time_budget",
                file=sys.stderr,
            )
        usual = statistics.median_low(self._speeds) / self.seconds  # part of the schedule, of an iteration
        return max(left / self._speed, math.ceil(undone / (_MOST_SHARE * usual)))

    def _count(self, iterations: float) -> tuple[int, bool]:
        """Iterations of the next block, and whether the run ends with it. iterations: that are left."""
        if iterations == 0.0:
            return 1, True
        if self._speed is None:
            return 1, False
        if self._measured == 1:
            return 1, iterations < 0.5
        previous = self.blocks[-1].last - self._last(len(self.blocks) - 1)
        block = max(1.0, min(_MOST_GROWTH * previous, PART * self.seconds / self._speed))
        if iterations < _LAST * block:
            return max(1, int(iterations + 0.5)), True
        return int(block), False
