"""The pace of a run whose iterations show several views each (--parallel views)."""

import math
from collections.abc import Sequence

from splatting.training.schedule.pace import Pace


class Batched(Pace):
    """Each iteration stands for as many of the schedule as it shows views, so all show as many views together.

    Rates without a schedule of their own are multiplied by the root of the number of views, and Adam's betas are raised
    to its power, so that averages reach as far back in views (Zhao et al. 2024, Grendel: their two scaling rules).
    """

    def __init__(self, length: int, views: int) -> None:
        super().__init__(length)
        self.views = views
        self.ends = math.ceil(length / views)

    def nominal(self, iteration: int) -> int:
        return min(iteration * self.views, self.length)

    def stride(self, iteration: int) -> float:
        return float(self.views)

    def rate_factor(self, iteration: int) -> float:
        return math.sqrt(self.views)

    def known(self, planned: Sequence[int]) -> list[int]:
        return [math.ceil(iteration / self.views) for iteration in planned if iteration <= self.length]
