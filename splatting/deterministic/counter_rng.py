"""Random numbers without state: a pure function of (seed, stream, iteration, item, draw).

Philox-4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3") in torch integer operations. A run
that resumes draws the numbers of an uninterrupted one without any saved state. Every device and number of threads draws
the same bits.
"""

from enum import IntEnum

import torch
from torch import Tensor

from splatting.deterministic.portable_math import cos_sin_turns, log

_MASK = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10


class Stream(IntEnum):
    """Purposes of random numbers; streams never overlap."""

    VIEW_ORDER = 0
    BACKGROUND = 1
    SPLIT = 2
    RELOCATION = 3
    NOISE = 4
    SCORED_VIEWS = 5
    DENSIFY = 6


def _multiply(x: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """High and low 32 bits of x * factor, by 16-bit halves of the factor so that int64 cannot overflow."""
    low = x * (factor & 0xFFFF)
    high = x * (factor >> 16)
    middle = low + ((high & 0xFFFF) << 16)
    return (high >> 16) + (middle >> 32), middle & _MASK


def philox(counter: Tensor, key: tuple[int, int]) -> Tensor:
    """Philox-4x32-10 of each row of `counter`, (n, 4) int64 below 2^32: (n, 4) int64 below 2^32."""
    c0, c1, c2, c3 = counter.unbind(-1)
    k0, k1 = key
    for _ in range(_ROUNDS):
        high0, low0 = _multiply(c0, _MULTIPLIERS[0])
        high1, low1 = _multiply(c2, _MULTIPLIERS[1])
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0, k1 = (k0 + _WEYL[0]) & _MASK, (k1 + _WEYL[1]) & _MASK
    return torch.stack((c0, c1, c2, c3), dim=-1)


def random_bits(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """Four 32-bit numbers per item. `items`: (n,) int64 indices below 2^32. Returns (n, 4) int64 on their device."""
    rest = torch.tensor([draw, iteration, int(stream)], dtype=torch.int64, device=items.device)
    counter = torch.cat((items[:, None], rest.expand(len(items), 3)), dim=1)
    return philox(counter, (seed & _MASK, (seed >> 32) & _MASK))


def uniform(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """Four numbers in [0, 1) per item: (n, 4) float32, multiples of 2^-24."""
    return (random_bits(seed, stream, iteration, items, draw) >> 8).to(torch.float32) * 2.0**-24


def normal(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """Four standard normal numbers per item (Box and Muller 1958): (n, 4) float64."""
    bits = random_bits(seed, stream, iteration, items, draw)
    radius = (log((bits[:, 0::2] + 1).to(torch.float64) * 2.0**-32) * -2.0).sqrt()
    cos, sin = cos_sin_turns(bits[:, 1::2])
    return torch.cat((radius * cos, radius * sin), dim=1)


def permutation(seed: int, stream: Stream, epoch: int, count: int) -> list[int]:
    """0 .. count-1 in random order: sorted by 63 random bits each."""
    bits = random_bits(seed, stream, epoch, torch.arange(count))
    return torch.argsort((bits[:, 0] << 31) ^ bits[:, 1], stable=True).tolist()
