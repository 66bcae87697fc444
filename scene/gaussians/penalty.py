"""A penalty on opacities and scales, as a part of the loss."""

from typing import NamedTuple


class Penalty(NamedTuple):
    """Weights of the mean opacity and of the mean scale (world units) of all Gaussians in the loss."""

    opacity: float = 0.0
    scale: float = 0.0

    def of_each(self, count: int) -> "Penalty":
        """The weights of one opacity and of one of the three scales, among `count` Gaussians."""
        return Penalty(self.opacity / max(count, 1), self.scale / max(3 * count, 1))

    def times(self, factor: float) -> "Penalty":
        """The weights times a factor."""
        return Penalty(factor * self.opacity, factor * self.scale)


NO_PENALTY = Penalty()
