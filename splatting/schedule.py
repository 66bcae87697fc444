"""The schedule of a run: maps its iterations to steps of the schedule, so that a run may be of any length.

Options count steps of a schedule, whose last is --iterations: windows of densification, resets, learning rates, and
when to test or save. A steady run takes each of them in one iteration. Another run is longer or shorter, and still goes
through the whole schedule: by the clock, or as a file says (splatting/features/time_budget.py).
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatting.run import Run

USUAL = 30_000  # iterations that the default learning rates are for
LONGER = 2.0  # times the root of the stride
MOST_RATE = 8.0  # about the best for 1,300 iterations in place of 30,000 (docs/inside/notebook.md)
SETTLING = 0.7  # part of the schedule from which on steps get shorter
LEAST_RATE = 0.1  # part of a rate that is left at the end


class Schedule:
    """The steady schedule: each iteration stands for itself.

    length: of the schedule, in iterations. ends: the last iteration of the run, None: not known yet. strategy: the one
    in force (--strategy). paced: whether iterations stand for more or fewer than themselves. by_clock: whether that
    follows the seconds that pass. seconds: that the run may take, 0: any number. until: the seconds of training that
    end a run by the clock. more: the option that continues a run that is over.
    """

    strategy = ""
    usual = USUAL
    paced = False
    by_clock = False
    seconds = until = 0.0
    more = "more --iterations"

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

    def rests(self, iteration: int) -> bool:
        """Whether a training ended with an iteration, so that it took no step, and was continued later."""
        return False

    def step_before(self, iteration: int) -> int:
        """From which `schedule_step` the iterations after this one continue."""
        return self.schedule_step(iteration)

    def span(self, iteration: int) -> range:
        """Iterations of the schedule that an iteration stands for; none where the run is slower than its schedule.

        The stop is one more than `schedule_step`.
        """
        return range(self.schedule_step(iteration - 1) + 1, self.schedule_step(iteration) + 1)

    def stride(self, iteration: int) -> float:
        """Iterations of the schedule that one of the run stands for, at that place."""
        return 1.0

    def usual_stride(self, iteration: int) -> float:
        """Iterations of the USUAL ones that one of the run stands for, at that place."""
        return self.stride(iteration) * USUAL / self.length

    def rate_factor(self, iteration: int) -> float | None:
        """Factor of the learning rates that have no schedule. None: they are left as they are."""
        return None

    def is_last(self, iteration: int) -> bool:
        """Whether a run that is not stopped ends with this iteration."""
        return iteration == self.ends

    def is_over(self, iteration: int) -> bool:
        """Whether nothing is left to do after an iteration."""
        return self.ends is not None and iteration >= self.ends

    def count_limit(self, iteration: int, count: int, limit: int, aim: int) -> int:
        """How many Gaussians there may be after an iteration, 0: any number.

        count: that are there. limit: as an option has it, 0: none. aim: how many a strategy is to reach.
        """
        return limit

    def best_strategy(self, run: "Run") -> str:
        """The strategy of a new run that names none: the first in the registry."""
        return run.strategies[0].name

    def nothing_left(self, checkpoint: str, iteration: int) -> str:
        """Why a run that would resume a checkpoint has nothing to do."""
        return (
            f"{checkpoint} is at iteration {iteration}, so --iterations {self.length} leaves nothing to do; "
            "--iterations counts from the start of the first run"
        )

    def known(self, planned: Sequence[int]) -> list[int]:
        """Return the iterations of the run at which planned ones of the schedule are due, as far as they are known."""
        return [iteration for iteration in planned if iteration <= self.length]


STEADY = Schedule(0)  # of no length, for those who only ask what an iteration stands for


def longer_steps(stride: float, progress: float) -> float:
    """Factor of learning rates where an iteration stands for `stride` of the USUAL ones.

    Few steps have to be longer ones: LONGER times the root of `stride`, at most MOST_RATE and at least 1. Towards the
    end all get shorter, smoothly, down to LEAST_RATE of that, so that the Gaussians settle. progress: part of the
    schedule that is done, 0 to 1.
    """
    longer = max(min(LONGER * math.sqrt(stride), MOST_RATE), 1.0)
    late = min(max(progress - SETTLING, 0.0) / (1.0 - SETTLING), 1.0)
    return longer * (1.0 - (1.0 - LEAST_RATE) * late * late * (3.0 - 2.0 * late))
