"""Schedule of the iterations that are scored for the curve of error against time, and on how many views."""

from collections.abc import Iterable

PER_OCTAVE = 4  # points while the number of iterations doubles
OCTAVES = 8  # before the last iteration: the first point lies at 1/256 of the training
SURE_FROM = 200  # iterations of a training; in a shorter one the budget alone decides
SURE_STEP, SURE_PLACES = 2, 24  # every second point over the last six octaves is scored at any cost: 13 points
SHARE = 0.035  # of the training's seconds that scoring may take; 0.05 is promised, and predicted costs may be too low
SURE_SHARE = 0.03  # that sure points may take by their estimate: a training that starts slowly makes them dearer
VIEW_COST = 0.5  # of scoring a view, in iterations, until it is measured: it takes no gradient and no step


def subset_size(iterations: int, tested: int, sets: int, views: int) -> int:
    """Number of a set's `views` that points between are scored on, so that the sure ones fit the budget; at least 1.

    It follows from the options alone, so that the same command scores the same views on every machine. tested: number
    of iterations that score all views, the last one included; sets: of views, of equal size.
    """
    sure = SURE_PLACES // SURE_STEP
    budget = SURE_SHARE * iterations / VIEW_COST - tested * sets * views
    return max(1, min(views, int(budget / (sets * sure))))


class CurveSchedule:
    """Points evenly spaced in the logarithm of the iteration, as many as the budget for scoring allows.

    The points are a fixed grid that ends with the last iteration, so that runs of one length share theirs. The
    iterations in `always` and the last one score all views, the others a subset (`subset_size`). Both kinds are scored
    at any cost, the latter if they are sure: so a curve has at least 12 points from SURE_FROM iterations on. The budget
    reserves them, and the points besides are scored as far as it goes. Each decision uses the seconds measured so
    far: the cost of a view in the last scoring, and the length of the training at the pace since the previous point. A
    pace may mislead: a training from 100,000 random Gaussians soon has a third of them. So a part of the grid may spend
    no more than the same part of the budget.
    """

    def __init__(self, first_iteration: int, iterations: int, always: Iterable[int], views: int, subset: int) -> None:
        """first_iteration: done already. iterations: the last one. views, subset: rendered by one scoring."""
        ahead = range(first_iteration + 1, iterations + 1)
        places = {
            round(iterations * 2 ** (-place / PER_OCTAVE)): place for place in range(PER_OCTAVE * OCTAVES, -1, -1)
        }
        self._places = {iteration: place for iteration, place in places.items() if iteration in ahead}
        self._always = {t for t in always if t in ahead} | {iterations}
        sure = range(0, SURE_PLACES + 1, SURE_STEP) if iterations >= SURE_FROM else ()
        self._sure = {t for t, place in self._places.items() if place in sure}
        self._iterations = iterations
        self._views = views
        self._subset = subset
        self._seen = (first_iteration, 0.0)
        self._costs: list[float] = []
        self._view_cost = 0.0  # seconds, of the last scoring

    def due(self, iteration: int, seconds: float) -> bool:
        """Whether to score after `seconds` of training in this run. Ask in every iteration, in ascending order."""
        if not self.has(iteration):
            return False
        pace = (seconds - self._seen[1]) / (iteration - self._seen[0])
        self._seen = (iteration, seconds)
        if iteration in self._always or iteration in self._sure:
            return True
        # The first scoring includes warm-up. If a slow one counted as the cost, the curve would end with it.
        view_cost = self._view_cost if len(self._costs) > 1 else VIEW_COST * pace
        cost = view_cost * self._subset
        budget = SHARE * (seconds + pace * (self._iterations - iteration))
        if self.spent + cost > budget * (1 - self._places[iteration] / (PER_OCTAVE * OCTAVES + 1)):
            return False
        ahead = [t for t in self._places if t >= iteration and t not in self._always]
        sure = sum(t in self._sure for t in ahead)
        reserved = view_cost * self._views * sum(t > iteration for t in self._always) + cost * sure
        return budget - self.spent - reserved >= cost * (len(ahead) - sure)

    def has(self, iteration: int) -> bool:
        """Whether an iteration is one of the points."""
        return iteration in self._places or iteration in self._always

    def whole(self, iteration: int) -> bool:
        """Whether an iteration scores all views."""
        return iteration in self._always or self._subset == self._views

    def scored(self, iteration: int, seconds: float) -> None:
        """Note the cost of the scoring just done."""
        self._view_cost = seconds / max(self._views if self.whole(iteration) else self._subset, 1)
        self._costs.append(seconds)

    @property
    def spent(self) -> float:
        """Seconds spent on all scorings."""
        return sum(self._costs)

    @property
    def scorings(self) -> int:
        """Number of scorings."""
        return len(self._costs)
