"""Schedule of the iterations that are scored for the curve of error against time."""

from collections.abc import Iterable

PER_OCTAVE = 4  # points while the number of iterations doubles
OCTAVES = 8  # before the last iteration: the first point lies at 1/256 of the training
SHARE = 0.04  # of the training's seconds that scoring may take; 0.05 is promised, and predicted costs may be too low
VIEW_COST = 0.5  # of scoring a view, in iterations, until it is measured: it takes no gradient and no step


class CurveSchedule:
    """Points evenly spaced in the logarithm of the iteration, as many as the budget for scoring allows.

    The points are a fixed grid that ends with the last iteration, so that runs of one length share theirs. If scoring
    all would take too long, every second, fourth, ... point is scored. Each decision uses the seconds measured so
    far: the cost of the last scoring, and the length of the training at the pace since the previous point. A pace may
    mislead: a training from 100,000 random Gaussians soon has a third of them. So a part of the grid may spend no more
    than the same part of the budget. The iterations in `always` and the last one are scored at any cost; the budget
    reserves it.
    """

    def __init__(self, first_iteration: int, iterations: int, always: Iterable[int], views: int) -> None:
        """first_iteration: done already. iterations: the last one. views: rendered by one scoring."""
        ahead = range(first_iteration + 1, iterations + 1)
        places = {
            round(iterations * 2 ** (-place / PER_OCTAVE)): place for place in range(PER_OCTAVE * OCTAVES, -1, -1)
        }
        self._places = {iteration: place for iteration, place in places.items() if iteration in ahead}
        self._always = {t for t in always if t in ahead} | {iterations}
        self._iterations = iterations
        self._views = views
        self._seen = (first_iteration, 0.0)
        self._costs: list[float] = []

    def due(self, iteration: int, seconds: float) -> bool:
        """Whether to score after `seconds` of training in this run. Ask in every iteration, in ascending order."""
        if iteration not in self._places and iteration not in self._always:
            return False
        pace = (seconds - self._seen[1]) / (iteration - self._seen[0])
        self._seen = (iteration, seconds)
        if iteration in self._always:
            return True
        place = self._places[iteration]
        # The first scoring includes warm-up. If a slow one counted as the cost, the curve would end with it.
        cost = self._costs[-1] if len(self._costs) > 1 else VIEW_COST * self._views * pace
        budget = SHARE * (seconds + pace * (self._iterations - iteration))
        if self.spent + cost > budget * (1 - place / (PER_OCTAVE * OCTAVES + 1)):
            return False
        affordable = (budget - self.spent) / max(cost, 1e-9) - sum(t > iteration for t in self._always)
        stride = 1
        while stride <= place and place // stride > affordable:  # place 0 is the last iteration, reserved above
            stride *= 2
        return place % stride == 0

    def scored(self, seconds: float) -> None:
        """Note the cost of the scoring just done."""
        self._costs.append(seconds)

    @property
    def spent(self) -> float:
        """Seconds spent on all scorings."""
        return sum(self._costs)

    @property
    def scorings(self) -> int:
        """Number of scorings."""
        return len(self._costs)
