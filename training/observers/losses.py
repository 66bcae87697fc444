"""Losses of the last iterations, left on their device until somebody looks."""

import torch
from torch import Tensor

NEWEST = 0.4  # weight of the newest loss in the running mean, the reference's


class LossWatch:
    """Takes a loss per iteration without waiting for it; `read` waits once for all of them.

    mean: exponential running mean of all that were read, from the given one on (of the run before, or 0).
    """

    def __init__(self, mean: float = 0.0) -> None:
        self.mean = mean
        self._losses: dict[int, Tensor] = {}

    def add(self, iteration: int, loss: Tensor) -> None:
        """Note the scalar loss of an iteration."""
        self._losses[iteration] = loss.detach()

    def read(self) -> dict[int, float]:
        """Losses by iteration since the last read."""
        if not self._losses:
            return {}
        values = torch.stack(list(self._losses.values())).tolist()
        read = dict(zip(self._losses, values, strict=True))
        self._losses.clear()
        for value in values:
            self.mean = NEWEST * value + (1 - NEWEST) * self.mean
        return read
