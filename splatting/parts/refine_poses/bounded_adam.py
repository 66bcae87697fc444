"""Twists of cameras that are trained on the host: bounded, each with steps of Adam of its own."""

import math

import numpy as np

from scene.reprojection import BOUND

_BETAS, _EPS = (0.9, 0.99), 1e-12


class BoundedAdam:
    """Twists (n, 6) float64 that begin at 0, with Adam's averages and counts of steps (Kingma and Ba 2015).

    Neither the rotation nor the translation of a twist gets longer than BOUND.
    """

    def __init__(self, count: int) -> None:
        self.values, self.mean, self.square = (np.zeros((count, 6)) for _ in range(3))
        self.counts = np.zeros(count)

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
        for part in (slice(3), slice(3, 6)):
            length = math.hypot(*values[part].tolist())
            if length > BOUND:
                values[part] *= BOUND / length
        self.values[row] = values
