"""Random numbers without state: a pure function of (seed, stream, iteration, item, draw).

Philox-4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"). A run that resumes draws the numbers
of an uninterrupted one without any saved state. Every device and number of threads draws the same bits.
"""

from enum import IntEnum

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.density import random_words
from torch import Tensor


class Stream(IntEnum):
    """Purposes of random numbers; streams never overlap."""

    VIEW_ORDER = 0
    BACKGROUND = 1
    SPLIT = 2
    RELOCATION = 3
    NOISE = 4
    SCORED_VIEWS = 5
    DENSIFY = 6


def random_bits(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """Four 32-bit numbers per item. `items`: (n,) int64 indices below 2^32. Returns (n, 4) int64 on their device."""
    return random_words(items, seed=seed, stream=stream, iteration=iteration, draw=draw)


def uniform(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """Four numbers in [0, 1) per item: (n, 4) float32, multiples of 2^-24."""
    return (random_bits(seed, stream, iteration, items, draw) >> 8).to(torch.float32) * 2.0**-24


def permutation(seed: int, stream: Stream, epoch: int, count: int) -> list[int]:
    """0 .. count-1 in random order: sorted by 63 random bits each."""
    bits = random_bits(seed, stream, epoch, torch.arange(count))
    return torch.argsort((bits[:, 0] << 31) ^ bits[:, 1], stable=True).tolist()
