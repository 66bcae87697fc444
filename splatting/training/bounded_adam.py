"""Small corrections that are trained on the host: bounded numbers, each row with steps of Adam of its own."""

import math
from collections.abc import Sequence

import numpy as np

_BETAS, _EPS = (0.9, 0.99), 1e-12


class BoundedAdam:
    """Rows of numbers (n, k) float64 that begin at 0, with Adam's averages and counts of steps (Kingma and Ba 2015).

    ends: of the parts of a row, none of which gets longer than the bound.
    """

    def __init__(self, count: int, ends: Sequence[int], bound: float) -> None:
        self.values, self.mean, self.square = (np.zeros((count, ends[-1])) for _ in range(3))
        self.counts = np.zeros(count)
        self._parts, self._bound = [slice(*part) for part in zip((0, *ends), ends, strict=False)], bound

    @property
    def state(self) -> tuple[np.ndarray, ...]:
        """All arrays, which a resumed training needs."""
        return self.values, self.mean, self.square, self.counts

    def step(self, row: int, gradient: np.ndarray, rate: float) -> None:
        """Take the step of a row. One whose gradient is not finite is only counted."""
        count = self.counts[row] = float(self.counts[row]) + 1
        if not np.isfinite(gradient).all():
            return
        mean = self.mean[row] = _BETAS[0] * self.mean[row] + (1 - _BETAS[0]) * gradient
        square = self.square[row] = _BETAS[1] * self.square[row] + (1 - _BETAS[1]) * gradient**2
        to_mean, to_square = (1 - beta**count for beta in _BETAS)
        values = self.values[row] - rate * (mean / to_mean) / (np.sqrt(square / to_square) + _EPS)
        for part in self._parts:
            length = math.hypot(*values[part].tolist())
            if length > self._bound:
                values[part] *= self._bound / length
        self.values[row] = values
