"""A pace that follows the clock, so that a run takes the seconds it was given (--time_budget)."""

import math
import statistics
import sys

from tqdm import tqdm

from splatting.distributed.ranks import ranks
from splatting.training.schedule.pace import PYRAMID, Block, Paced, Schedule

PART = 1 / 200  # of the budget that a block takes, so that what is left is known well before the end
_MOST_GROWTH = 2  # of a block over the one before, while the first iterations are slower than the others
_KNOWN = 1 / 50  # of the budget, after which the speed says how many iterations there may be
SHORT = 6.0  # iterations of the schedule for each one, from which on smaller views at first gain more than they lose
_LAST = 1.5  # blocks; if no more are left, they are one
_MOST_SHARE = 2  # times the part of the schedule that an iteration does where no seconds are lost
_TOLD = 1.02  # times the budget, from which on a run says that it takes longer


class Clocked(Paced):
    """Goes through the schedule as the seconds of training pass, and ends with them.

    A block of iterations does as large a part of what is left of the schedule as it will take of the seconds that are
    left, at the speed of the blocks before it. So seconds that were lost, by a slow start or by another program, are
    taken from all that is left. Where so many were lost that iterations would do more than _MOST_SHARE times their
    usual part, the run takes longer than its budget. Seconds are those of training, with those of the runs that this
    one resumes, whose blocks are in the schedule.
    """

    def __init__(self, schedule: Schedule) -> None:
        super().__init__(schedule)
        self._open = self.sizes == "auto"
        if self._open:
            self.sizes = "none"
        self._budget = schedule.time_budget
        self._speed: float | None = None  # seconds of an iteration
        self._speeds: list[float] = []  # of the last three blocks
        self._measured = 0  # blocks of this run
        self._first = self.blocks[-1].last if self.blocks else 0
        self._told = False

    def reach(self, iteration: int, seconds: float) -> None:
        if not self.blocks or iteration > self.blocks[-1].last:
            seconds = ranks().shared(seconds)
            self._measure(seconds)
            if self._open and self._measured > 2 and seconds > _KNOWN * self._budget:
                self._choose_sizes(iteration - 1, seconds)
            self._decide(seconds)

    def recorded(self, iteration: int, last: bool) -> Schedule:
        return self.up_to(iteration)._replace(ended=iteration if last else None)

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
        """Take smaller views if few iterations are possible: from the next one on, and all of that is recorded."""
        self._open = False
        now = (self.nominal(done) + 0.5) / self.length
        possible = done + max(self._budget - seconds, 0.0) / self._speed
        short = self.length / possible >= SHORT and now < PYRAMID[1][0]
        self.sizes = "pyramid" if short else "none"
        self.levels = ((now, PYRAMID[0][1]), *PYRAMID[1:]) if short else ()

    def _decide(self, seconds: float) -> None:
        """Add the block that comes next."""
        before = self.blocks[-1].last if self.blocks else 0
        done = self.progress(before)
        iterations = self._iterations(seconds, 1.0 - done)
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
                f"warning: --time_budget {self._budget:g} is too short for {self.ends + 1} iterations, so training "
                f"ends with iteration {self.ends}; give more seconds, or lower --resolution (-r)",
                file=sys.stderr,
            )

    def _iterations(self, seconds: float, undone: float) -> float:
        """Iterations that the run has yet to take, infinite where no speed is known. undone: part of the schedule."""
        left = max(self._budget - seconds, 0.0)
        if self._speed is None:
            return math.inf if left else 0.0
        if not self._speeds:
            return left / self._speed
        if not self._told and seconds + undone * self._budget / _MOST_SHARE > _TOLD * self._budget:
            self._told = True
            tqdm.write(
                "warning: some iterations took so long that the training needs about "
                f"{seconds + undone * self._budget / _MOST_SHARE:.0f} s, not the {self._budget:g} s of --time_budget",
                file=sys.stderr,
            )
        usual = statistics.median_low(self._speeds) / self._budget  # part of the schedule, of an iteration
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
        block = max(1.0, min(_MOST_GROWTH * previous, PART * self._budget / self._speed))
        if iterations < _LAST * block:
            return max(1, int(iterations + 0.5)), True
        return int(block), False
