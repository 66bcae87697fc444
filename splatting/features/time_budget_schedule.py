"""Schedules that a run goes through in fewer or more iterations than they have: by the clock, or as an earlier run.

A block is a number of consecutive iterations, each of which does the same part of the schedule. A run by the clock
(`TimeBudget`) decides one block after the other, from the speed of the blocks before. The decisions are recorded
(`Decided`), and a `DecidedSchedule` repeats them without a clock, so that the same iterations do the same again.
"""

import math
import statistics
import sys
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from tqdm import tqdm

from splatting.schedule import Schedule, stride_rate_factor

_PACE = 5  # blocks that tell the pace of a run
_ROUNDING = 1e-6  # iterations of the schedule; progress is a float, and just below a whole number counts as that
PART = 1 / 200  # of the budget that a block takes, so that what is left is known well before the end
_MOST_GROWTH = 2  # of a block over the one before, while the first iterations are slower than the others
_KNOWN = 1 / 50  # of the budget, after which the speed says how many iterations there may be
# Megapixels of the schedule for each iteration, from which on it pays to begin with smaller views. On a GPU these take
# hardly less time: in six seconds bonsai_full, with 2.1 megapixels, lost 0.13 dB by them.
SHORT = {"cpu": 4.0, "cuda": 12.0}
_LAST = 1.5  # blocks; if no more are left, they are one
_MOST_SHARE = 2  # times the part of the schedule that an iteration does where no seconds are lost
_TOLD = 1.02  # times the budget, from which on a run says that it takes longer
# Gaussians for each iteration, at most, where the clock sets the number of iterations. On a GPU, which takes hardly
# more time for more, times `band_rate`: they overfit to few photos (50: bonsai_full +0.26 dB, fox_full SSIM -0.003).
AN_ITERATION = 25
AGAIN = 0.9  # part of the schedule at which one that is over continues: rates are low there, and fall once more

Levels = Sequence[tuple[float, float]]  # part of the schedule that is done (0 to 1), and factor of sizes from then on

PYRAMID: Levels = ((0.0, 4.0), (0.1, 2.0), (0.25, 1.0))
AUTO = "auto"  # sizes that are not decided yet


class Block(NamedTuple):
    """Iterations that each do the same part of the schedule, from the one after the block before to `last`."""

    last: int
    start: float  # part of the schedule that is done before the block, 0 to 1
    step: float  # part of the schedule that each iteration does
    seconds: float  # of training before the block


class Continued(NamedTuple):
    """The continuation of a training that was over, and got more time."""

    after: int  # its last iteration then, which took no step
    seconds: float  # more


class Decided(NamedTuple):
    """The decisions of a run, as schedule.json and checkpoints keep them (time_budget_file.py)."""

    iterations: int  # of its schedule
    blocks: list[Block]
    ended: int | None  # the last iteration, None if the run has not ended
    time_budget: float  # seconds, without those of `continued`
    sizes: str = "none"  # of views
    levels: Levels = ()
    strategy: str = ""  # that trained; empty in files of older versions
    continued: tuple[Continued, ...] = ()
    begun: float | None = None  # seconds of training before those that now pass; None: as many as there are


class DecidedSchedule(Schedule):
    """Repeats the schedule that an earlier run has decided. It reads no clock: each iteration does what it did then.

    Attributes besides those of `Schedule`:

    blocks: the blocks in order. No iteration behind the last block may be asked for.
    levels: parts of the schedule, and the factors by which views are smaller from there on.
    sizes: name of `levels` in files and options.
    begun: seconds of training before those that the budget counts; None: not decided.

    The part TimeBudget sets the next four when the run begins (splatting/features/time_budget.py):

    megapixels: size of a training view on average.
    short: megapixels of the whole schedule for each iteration of the run, from which on a run by the clock begins with
        smaller views; it is SHORT of the device.
    an_iteration: largest number of Gaussians for each iteration that fits into the time.
    random: true if the model began as random points, of which those may be removed that the run cannot train.
    """

    megapixels = 1.0
    an_iteration: float = AN_ITERATION
    short = SHORT["cpu"]
    random = False
    paced = True
    more = "--time_budget SECONDS"
    _told = False

    def __init__(self, decided: Decided) -> None:
        """Follow recorded decisions from the first block on.

        decided: decisions of an earlier run, from schedule.json or a checkpoint.
        """
        super().__init__(decided.iterations)
        self._decided = decided
        self.blocks = list(decided.blocks)
        self.ends = decided.ended
        self.sizes, self.levels, self.strategy = decided.sizes, decided.levels, decided.strategy
        self.seconds, self.begun = decided.time_budget, decided.begun
        self._rests = {one.after for one in decided.continued}  # iterations without a step: there a run was over

    def progress(self, iteration: int) -> float:
        """Return the part of the schedule that is done after an iteration, 0 to 1."""
        if iteration <= 0:
            return 0.0
        index, block = self._find_block(iteration)
        return block.start + block.step * (iteration - self._end_before(index))

    def schedule_step(self, iteration: int) -> int:
        """Return the step of the schedule, 0 to `length`, of an iteration; `length` only where a run ends."""
        if iteration <= 0:
            return 0
        # The end of the schedule is only reached in a last iteration.
        most = self.length if self.is_last(iteration) or self.rests(iteration) else self.length - 1
        return min(int(self.length * self.progress(iteration) + _ROUNDING), most)

    def rests(self, iteration: int) -> bool:
        return iteration in self._rests

    def step_before(self, iteration: int) -> int:
        return int(AGAIN * self.length) if self.rests(iteration) else self.schedule_step(iteration)

    def stride(self, iteration: int) -> float:
        return self._find_block(iteration)[1].step * self.length

    @property
    def possible_levels(self) -> Levels:
        """The levels that may come into force."""
        return self.levels

    def factor_at(self, schedule_step: float) -> float:
        """Return the factor of the views' sizes at an iteration of the schedule."""
        index = bisect_right(self.levels, schedule_step, key=lambda level: level[0] * self.length) - 1
        return self.levels[index][1] if index >= 0 else 1.0

    def possible(self, iteration: int) -> float:
        """Return the number of iterations that fit into the budget, by the pace that the run will have at its end.

        Blocks before this iteration tell that pace, except those with smaller views. Where no block tells it, return
        the number of iterations at the present stride.
        """
        index, present = self._find_block(iteration)
        spans = zip([0, *(block.last for block in self.blocks)], self.blocks[:index], self.blocks[1:], strict=False)
        speeds = [
            (after.seconds - block.seconds) / (block.last - before)
            for before, block, after in spans
            if self.factor_at(self.length * (block.start + block.step)) == 1
        ]
        speed = statistics.median(speeds[-_PACE:]) if speeds else 0.0
        return self.seconds / speed if speed > 0 else 1 / present.step

    def count_limit(self, iteration: int, count: int, limit: int, aim: int) -> int:
        """Return the number of Gaussians that so few iterations can train; present ones stay, except random points."""
        if not self.seconds or (possible := self.possible(iteration)) >= self.length:
            return limit
        trained = max(int(self.an_iteration * possible), 1)
        if limit and trained >= limit:
            return limit
        self._report_limit(int(possible), trained, aim)
        most = trained if self.random else max(trained, count)
        return min(limit, most) if limit else most

    def _report_limit(self, iterations: int, trained: int, aim: int) -> None:
        """Print once how many Gaussians a time budget can train."""
        if not self._told:
            self._told = True
            steps, enough = (int(float(f"{count:.2g}")) for count in (iterations, trained))
            aimed = f", not for {aim:,}" if aim else ""
            tqdm.write(
                f"In {self.seconds:g} s this machine takes about {steps:,} steps, enough for {enough:,} "
                f"Gaussians{aimed}",
                file=sys.stderr,
            )

    def best_strategy(self, run: Any, strategies: Sequence[Any]) -> str:
        return self.strategy or super().best_strategy(run, strategies)

    def nothing_left_message(self, checkpoint: str, iteration: int) -> str:
        return (
            f"{checkpoint} is at iteration {iteration}, and its schedule ends at {self.ends}; there is nothing left to "
            "train"
        )

    def rate_factor(self, iteration: int) -> float:
        return stride_rate_factor(self.usual_stride(iteration), self.progress(iteration))

    def known(self, planned: Sequence[int]) -> list[int]:
        return [self.ends] if self.ends is not None and self.length in planned else []

    @property
    def decided(self) -> Decided:
        """All decisions up to now, for a record; the last block may reach beyond the present iteration."""
        decided = {"sizes": self.sizes, "levels": self.levels, "strategy": self.strategy, "begun": self.begun}
        return self._decided._replace(blocks=self.blocks, ended=self.ends, **decided)

    def up_to(self, iteration: int) -> Decided:
        """Return the decisions as of a run that went no further than an iteration, for the files written there."""
        index, block = self._find_block(iteration)
        blocks = [*self.blocks[:index], block._replace(last=iteration)]
        return self.decided._replace(blocks=blocks, ended=iteration if self.is_last(iteration) else None)

    def _find_block(self, iteration: int) -> tuple[int, Block]:
        """Return the index of the block to which an iteration belongs, and the block."""
        index = bisect_left(self.blocks, iteration, key=lambda block: block.last)
        return index, self.blocks[index]

    def _end_before(self, index: int) -> int:
        """Return the last iteration before the block of an index, 0 for the first block."""
        return self.blocks[index - 1].last if index else 0


class TimeBudget(DecidedSchedule):
    """Goes through the schedule as the seconds of training pass, and ends with them.

    A block of iterations does as large a part of the rest of the schedule as it will take of the seconds that are left,
    at the speed of the blocks before it. So seconds that were lost, by a slow start or by another program, are taken
    from all the rest. If so many were lost that iterations would do more than _MOST_SHARE times their usual part, the
    run takes longer than its budget. Seconds are those of training, and include the runs that this one resumes, whose
    blocks are in the schedule. A run that was over continues at AGAIN, for as many seconds more.

    share: function that gives all processes the seconds of one.
    """

    by_clock = True

    def __init__(self, decided: Decided, share: Callable[[float], float] = lambda seconds: seconds) -> None:
        """Continue the blocks of the runs that are resumed; a new run has none."""
        super().__init__(decided)
        self._share = share
        self._limit = decided.continued[-1].seconds if decided.continued else decided.time_budget
        self._open = self.sizes == AUTO
        self.sizes = "none" if self._open else self.sizes
        self._speed: float | None = None  # seconds of an iteration
        self._speeds: list[float] = []  # of the last three blocks
        self._measured = 0  # blocks of this run
        self._first = self.blocks[-1].last if self.blocks else 0
        self._is_late_told = False
        self._expected: float | None = None

    @property
    def possible_levels(self) -> Levels:
        return self.levels or (PYRAMID if self._open else ())

    def best_strategy(self, run: Any, strategies: Sequence[Any]) -> str:
        """Return the strategy that is best in the seconds, among those that the run's parts work with."""
        against = {conflict for part in run.parts for conflict in part.against}  # such as a sky that was found
        fit = [one for one in strategies if f"strategy={one.name}" not in against]
        best = (one.name for one in fit if one.best_in(self.seconds, run))
        strategy = next(best, super().best_strategy(run, strategies))
        print(f"--time_budget chose --strategy {strategy}; give --strategy to use another one")
        return strategy

    @property
    def expected(self) -> float | None:
        return self._expected if self.ends is None else float(self.ends)

    @property
    def until(self) -> float:
        return (self.begun or 0.0) + self._limit

    def reach(self, iteration: int, seconds: float) -> None:
        """Decide the next block of iterations once the last one is over, and at first the sizes of views.

        seconds: seconds of training before the iteration.
        """
        if not self.blocks or iteration > self.blocks[-1].last:
            seconds = round(self._share(seconds), 6)
            if self.begun is None or seconds < self.begun:  # the log of those before may be lost
                self.begun = seconds
            self._measure_speed(seconds)
            if self._open and self._measured > 2 and seconds - self.begun > _KNOWN * self._limit:
                self._choose_sizes(iteration - 1, seconds)
            self._add_block(seconds)

    def _measure_speed(self, seconds: float) -> None:
        """Measure the speed of the last block, if this run has taken it."""
        if not self.blocks or self.blocks[-1].last == self._first:
            return
        block, before = self.blocks[-1], self._end_before(len(self.blocks) - 1)
        speed = max(seconds - block.seconds, 1e-9) / (block.last - before)
        self._measured += 1
        # The first iteration loads kernels and photos, so it is no measure of the others.
        self._speed = speed if self._measured <= 2 else (self._speed + speed) / 2
        if self._measured > 1:
            self._speeds = [*self._speeds[-2:], speed]

    def _choose_sizes(self, done: int, seconds: float) -> None:
        """Choose smaller views, from the next iteration on, if few pixels can be trained.

        The first views are never smaller, because they tell the pace of the end.
        """
        self._open = False
        now = (self.schedule_step(done) + 0.5) / self.length
        possible = done + max(self.until - seconds, 0.0) / self._speed
        if self.megapixels * self.length / possible >= self.short and now < PYRAMID[1][0]:
            self.sizes = "pyramid"
            begun = [factor for start, factor in PYRAMID if start <= now][-1]
            self.levels = ((now, begun), *(level for level in PYRAMID if level[0] > now))

    def _add_block(self, seconds: float) -> None:
        """Add the next block: choose its number of iterations, and the part of the schedule that each does.

        seconds: seconds of training before the block.
        """
        before = self.blocks[-1].last if self.blocks else 0
        done = AGAIN if self.rests(before) else self.progress(before)
        iterations = self._count_left(seconds - self.begun, (1.0 - done) / (1.0 - AGAIN if self._rests else 1.0))
        self._expected = before + iterations if self._speeds else None
        count, final = self._size_block(iterations)
        if final:
            step = (1.0 - done) / count
            self.ends = before + count
        elif self._speed is None:
            step = min(1.0 / self.length, (1.0 - done) / 2)
        else:
            step = (1.0 - done) * min(1.0 / iterations, 0.5 / count)
        self.blocks.append(Block(before + count, done, step, seconds))
        if final and self._measured <= 1:
            tqdm.write(
                f"warning: --time_budget {self._limit:g} is too short for {self.ends + 1} iterations, so training "
                f"ends with iteration {self.ends}; give more seconds, or lower --resolution (-r)",
                file=sys.stderr,
            )

    def _count_left(self, seconds: float, undone: float) -> float:
        """Return the number of iterations that the run has yet to take, infinite where no speed is known.

        seconds: seconds of the limit that have passed.
        undone: share that is left of the part of the schedule which the run has to do.
        """
        left = max(self._limit - seconds, 0.0)
        if self._speed is None:
            return math.inf if left else 0.0
        if not self._speeds:
            return left / self._speed
        if not self._is_late_told and seconds + undone * self._limit / _MOST_SHARE > _TOLD * self._limit:
            self._is_late_told = True
            tqdm.write(
                f"warning: training will take about {seconds + undone * self._limit / _MOST_SHARE:.0f} s, more than "
                f"--time_budget {self._limit:g}, because some iterations were slow",
                file=sys.stderr,
            )
        usual = statistics.median_low(self._speeds) / self._limit  # part of that, of an iteration
        return max(left / self._speed, math.ceil(undone / (_MOST_SHARE * usual)))

    def _size_block(self, iterations: float) -> tuple[int, bool]:
        """Return the number of iterations of the next block, and whether the run ends with it.

        iterations: number of iterations that are left.
        """
        if iterations == 0.0:
            return 1, True
        if self._speed is None:
            return 1, False
        if self._measured == 1:
            return 1, iterations < 0.5
        previous = self.blocks[-1].last - self._end_before(len(self.blocks) - 1)
        block = max(1.0, min(_MOST_GROWTH * previous, PART * self._limit / self._speed))
        if iterations < _LAST * block:
            return max(1, int(iterations + 0.5)), True
        return int(block), False
