"""Which iterations of a training are scored for its curve of error against time."""

from collections.abc import Iterable

PER_OCTAVE = 4  # points while the number of iterations doubles
OCTAVES = 8  # before the last iteration: the first point lies at 1/256 of the training
SHARE = 0.04  # of the training's seconds for scoring: costs are guessed ahead, and 0.05 is what is promised
VIEW_COST = 0.5  # of scoring a view, in iterations, until it is measured: there is no gradient and no step


class CurveSchedule:
    """Points evenly spaced in the logarithm of the iteration, as many as scoring may cost.

    The points are a fixed grid that ends with the last iteration, so that runs of one length share theirs. Where
    scoring all is too dear, every second, fourth, ... is taken. Chosen anew at each from seconds measured so far: cost
    of the last scoring, and length of the training at the pace since the point before. A pace may be misleading (one
    that begins with 100,000 random Gaussians soon has a third of them), so up to a part of the grid no more than that
    part may have been spent. The iterations in `always` and the last one are scored at any cost, and what they will
    cost is set aside.
    """

    def __init__(self, first_iteration: int, iterations: int, always: Iterable[int], views: int) -> None:
        """first_iteration: what is done already; iterations: the last one; views: how many a scoring renders."""
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
        """Whether to score after `seconds` of training in this run. To be asked in each iteration, ascending."""
        if iteration not in self._places and iteration not in self._always:
            return False
        pace = (seconds - self._seen[1]) / (iteration - self._seen[0])
        self._seen = (iteration, seconds)
        if iteration in self._always:
            return True
        place = self._places[iteration]
        # Not measured by the first scoring, which also warms up: a dear one would end the curve.
        cost = self._costs[-1] if len(self._costs) > 1 else VIEW_COST * self._views * pace
        budget = SHARE * (seconds + pace * (self._iterations - iteration))
        if self.spent + cost > budget * (1 - place / (PER_OCTAVE * OCTAVES + 1)):
            return False
        affordable = (budget - self.spent) / max(cost, 1e-9) - sum(t > iteration for t in self._always)
        stride = 1
        while stride <= place and place // stride > affordable:  # place 0 is the last iteration, set aside above
            stride *= 2
        return place % stride == 0

    def scored(self, seconds: float) -> None:
        """Tell what the scoring just done has cost."""
        self._costs.append(seconds)

    @property
    def spent(self) -> float:
        """Seconds of all scorings."""
        return sum(self._costs)

    @property
    def scorings(self) -> int:
        """How many there were."""
        return len(self._costs)
