"""Late iterations that share a step of the optimisers (--views_per_step)."""

from collections.abc import Callable, Iterable

from training.density import DensityControl


class LateSteps:
    """Says which iterations share a step: after density control has ended, the optimisers step in every N-th only.

    The gradients of the others wait, and are added up. An iteration for which `changes` is true (SH degree, size of
    views) steps anyway, so that all gradients of a step are of one kind. All is a function of the iteration, so a
    resumed run steps in the same ones.
    """

    def __init__(self, views: int, density: DensityControl, changes: Callable[[int], bool]) -> None:
        self._views = views
        self._density = density
        self._changes = changes

    def shares(self, iteration: int) -> bool:
        """Whether the step of an iteration may be that of others, too."""
        return self._views > 1 and self._density.pace.nominal(iteration) >= self._density.ends

    def waits(self, iteration: int) -> bool:
        """Whether the gradients of an iteration wait for the step of a later one."""
        return self.shares(iteration) and iteration % self._views > 0 and not self._changes(iteration)

    def steps(self, iterations: Iterable[int]) -> int:
        """How many of the iterations take a step."""
        return sum(not self.waits(iteration) for iteration in iterations)

    def whole(self, iteration: int) -> int:
        """The last iteration, up to this one, after which no gradient waits."""
        while self.waits(iteration):
            iteration -= 1
        return iteration
