"""Comparison of calls on a machine whose speed drifts: the calls take turns and are compared within each round."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch


class Interval(NamedTuple):
    """A median with its 95 % confidence interval."""

    median: float
    low: float
    high: float

    @property
    def within_noise(self) -> bool:
        """Whether 0 is in the interval."""
        return self.low <= 0 <= self.high


def interleaved(calls: dict[str, Callable[[], object]], rounds: int, device: torch.device) -> dict[str, list[float]]:
    """Return the milliseconds of each call in each round, from an idle device until the device is done.

    Each round starts with the next call in turn. A first round is not counted.
    """

    def once(call: Callable[[], object]) -> float:
        _wait(device)
        start = time.perf_counter()
        call()
        _wait(device)
        return 1e3 * (time.perf_counter() - start)

    times: dict[str, list[float]] = {name: [] for name in calls}
    order = list(calls)
    for number in range(rounds + 1):
        for name in order[number % len(order) :] + order[: number % len(order)]:
            elapsed = once(calls[name])
            if number:
                times[name].append(elapsed)
    return times


def difference(after: Sequence[float], before: Sequence[float]) -> Interval:
    """Return the interval of the median of after - before within a round."""
    return median_interval([a - b for a, b in zip(after, before, strict=True)])


def median_interval(values: Sequence[float]) -> Interval:
    """Return the interval of the sign test, which uses order statistics and so assumes no distribution."""
    ordered, n = sorted(values), len(values)
    # The largest k with P(fewer than k of n coins show heads) <= 2.5 %.
    k, probability = 0, 0.5**n
    while probability <= 0.025:
        k += 1
        probability += math.comb(n, k) * 0.5**n
    low, high = (ordered[k - 1], ordered[n - k]) if k else (-math.inf, math.inf)
    return Interval(statistics.median(ordered), low, high)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
