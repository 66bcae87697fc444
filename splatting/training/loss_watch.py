"""Losses of the last iterations, which stay on their device until they are read."""

import torch
from torch import Tensor

NEWEST = 0.4  # weight of the newest loss in the running mean, as in the reference


class LossWatch:
    """Collects one loss per iteration without waiting for the device; `read` waits once for all of them.

    mean: exponential running mean of all losses read, starting at the given value.
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
