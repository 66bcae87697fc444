"""Losses of the last iterations, left on their device until somebody looks."""

import torch
from torch import Tensor

CAPACITY = 64
NEWEST = 0.4  # weight of the newest loss in the running mean, the reference's


class LossWatch:
    """Takes a loss per iteration without waiting for it; `read` waits once for all of them.

    mean: exponential running mean of all that were read, from the given one on (of the run before, or 0).
    """

    def __init__(self, device: torch.device | str, mean: float = 0.0) -> None:
        self.mean = mean
        self._losses = torch.empty(CAPACITY, device=device)
        self._iterations: list[int] = []

    def add(self, iteration: int, loss: Tensor) -> None:
        """Note the scalar loss of an iteration. At most CAPACITY between two reads."""
        self._losses[len(self._iterations)] = loss.detach()
        self._iterations.append(iteration)

    def read(self) -> dict[int, float]:
        """Losses by iteration since the last read."""
        values = self._losses[: len(self._iterations)].tolist()
        read = dict(zip(self._iterations, values, strict=True))
        self._iterations.clear()
        for value in values:
            self.mean = NEWEST * value + (1 - NEWEST) * self.mean
        return read
