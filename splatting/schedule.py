"""The schedule of a run: maps its iterations to steps of the schedule, so that a run may have any length.

Options count steps of a schedule, whose last step is --iterations: windows of densification, resets, learning rates,
and when to test or save. A steady run takes each of these steps in one iteration. Another run has more or fewer
iterations and still goes through the whole schedule: by the clock, or as a file says
(splatting/features/time_budget.py).
"""

import math
from collections.abc import Sequence
from typing import Any

USUAL = 30_000  # iterations that the default learning rates are for
LONGER = 2.0  # times the root of the stride
MOST_RATE = 8.0  # about the best for 1,300 iterations in place of 30,000 (docs/inside/notebook.md)
SETTLING = 0.7  # part of the schedule from which on steps get shorter
LEAST_RATE = 0.1  # part of a rate that is left at the end


class Schedule:
    """The steady schedule: each iteration stands for itself.

    length: length of the schedule, in iterations.
    ends: last iteration of the run, None: not known yet.
    strategy: strategy in force (--strategy).
    paced: true if iterations stand for more or fewer steps than one.
    by_clock: true if that follows the seconds that pass.
    seconds: seconds that the run may take, 0: any number.
    until: seconds of training at which a run by the clock ends.
    more: option that continues a run that is over.
    """

    strategy = ""
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
        """Decide for which steps the next iterations stand. Call it before each iteration.

        seconds: seconds of training before the iteration.
        """

    def schedule_step(self, iteration: int) -> int:
        """Return the step of the schedule, 0 to `length`, of an iteration that was reached."""
        return iteration

    def rests(self, iteration: int) -> bool:
        """Tell whether a training ended with an iteration, which took no step, and was continued later."""
        return False

    def step_before(self, iteration: int) -> int:
        """Return the `schedule_step` from which the iterations after this one continue."""
        return self.schedule_step(iteration)

    def span(self, iteration: int) -> range:
        """Return the schedule's steps that an iteration stands for; none where the run is slower than its schedule.

        The stop is one more than `schedule_step`.
        """
        return range(self.schedule_step(iteration - 1) + 1, self.schedule_step(iteration) + 1)

    def stride(self, iteration: int) -> float:
        """Return the number of steps of the schedule that an iteration stands for."""
        return 1.0

    def usual_stride(self, iteration: int) -> float:
        """Return the number of the USUAL iterations that an iteration stands for."""
        return self.stride(iteration) * USUAL / self.length

    def rate_factor(self, iteration: int) -> float | None:
        """Return the factor of learning rates that have no schedule of their own; None: the rates stay as they are."""
        return None

    def is_last(self, iteration: int) -> bool:
        """Tell whether a run that is not stopped ends with this iteration."""
        return iteration == self.ends

    def is_over(self, iteration: int) -> bool:
        """Tell whether nothing is left to do after an iteration."""
        return self.ends is not None and iteration >= self.ends

    def count_limit(self, iteration: int, count: int, limit: int, aim: int) -> int:
        """Return the largest number of Gaussians after an iteration, 0: any number.

        count: present number of Gaussians.
        limit: limit of an option, 0: none.
        aim: number that a strategy is to reach.
        """
        return limit

    def best_strategy(self, run: Any, strategies: Sequence[Any]) -> str:
        """Return the strategy of a new run that names none: the first of all."""
        return strategies[0].name

    def nothing_left_message(self, checkpoint: str, iteration: int) -> str:
        """Say why a run that would resume a checkpoint has nothing to do."""
        return (
            f"{checkpoint} is at iteration {iteration}, so --iterations {self.length} leaves nothing to do; "
            "--iterations counts from the start of the first run"
        )

    def known(self, planned: Sequence[int]) -> list[int]:
        """Return the run's iterations that stand for planned iterations of the schedule, as far as they are known."""
        return [iteration for iteration in planned if iteration <= self.length]


STEADY = Schedule(0)  # of no length, for those who only ask what an iteration stands for


def stride_rate_factor(stride: float, progress: float) -> float:
    """Return the factor of learning rates of an iteration that stands for `stride` of the USUAL ones.

    A run of few iterations takes longer steps: LONGER times the root of `stride`, at most MOST_RATE and at least 1.
    Towards the end all steps get shorter, smoothly, down to LEAST_RATE of that, so that the Gaussians settle.

    progress: part of the schedule that is done, 0 to 1.
    """
    longer = max(min(LONGER * math.sqrt(stride), MOST_RATE), 1.0)
    late = min(max(progress - SETTLING, 0.0) / (1.0 - SETTLING), 1.0)
    return longer * (1.0 - (1.0 - LEAST_RATE) * late * late * (3.0 - 2.0 * late))
