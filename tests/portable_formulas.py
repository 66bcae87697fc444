"""Formulas of density control's operators, in torch: exp, log, cos and sin in float64, and Philox.

Only operations that IEEE 754 rounds in one way are used, in the operators' order, so that the bits are the same.
"""

import math

import torch
from torch import Tensor

_LN2_HIGH = float.fromhex("0x1.62e42feep-1")  # 21 trailing zero bits: n * _LN2_HIGH is exact for every exponent n
_LN2_LOW = float.fromhex("0x1.a39ef35793c76p-33")


def _horner(x: Tensor, coefficients: list[float]) -> Tensor:
    """Polynomial in x by its coefficients, highest power first."""
    result = torch.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        result = result * x + coefficient
    return result


def exp(x: Tensor) -> Tensor:
    """e^x in float64 to a few units in the last place, |x| <= 700 (clamped). `x` of any floating type."""
    x = x.to(torch.float64).clamp(-700.0, 700.0)
    exponent = torch.round(x * (1.0 / math.log(2.0)))
    r = (x - exponent * _LN2_HIGH) - exponent * _LN2_LOW  # |r| <= 0.347: Taylor to r^13 leaves 4e-18
    mantissa = _horner(r, [1.0 / math.factorial(k) for k in range(13, -1, -1)])
    return mantissa * ((exponent.to(torch.int64) + 1023) << 52).view(torch.float64)


def log(x: Tensor) -> Tensor:
    """Natural logarithm of positive finite float64 numbers, to 1e-15 relative to max(1, |result|)."""
    mantissa, exponent = torch.frexp(x)
    small = mantissa < math.sqrt(0.5)
    mantissa = torch.where(small, mantissa * 2.0, mantissa)
    exponent = (exponent - small.to(exponent.dtype)).to(torch.float64)
    z = (mantissa - 1.0) / (mantissa + 1.0)  # log m = 2 atanh z, |z| <= 0.1716: z^23 / 23 is below 1e-18
    series = _horner(z * z, [2.0 / k for k in range(21, 0, -2)])
    return exponent * _LN2_HIGH + (exponent * _LN2_LOW + z * series)


def cos_sin_turns(turns: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin of 2 pi * turns / 2^32 for integers 0 <= turns < 2^32; float64, absolute error 1e-16."""
    quadrant = turns >> 30
    angle = (turns & 0x3FFFFFFF).to(torch.float64) * (math.pi / 2 * 2.0**-30)
    square = angle * angle  # angle < pi / 2: the first terms left out are below 1e-18
    cos = _horner(square, [(-1) ** (k // 2) / math.factorial(k) for k in range(22, -1, -2)])
    sin = angle * _horner(square, [(-1) ** (k // 2) / math.factorial(k + 1) for k in range(22, -1, -2)])
    swapped = (quadrant & 1).bool()
    cos, sin = torch.where(swapped, -sin, cos), torch.where(swapped, cos, sin)
    flipped = (quadrant & 2).bool()
    return torch.where(flipped, -cos, cos), torch.where(flipped, -sin, sin)


_MASK = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10


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


def random_words(seed: int, stream: int, iteration: int, items: Tensor, draw: int = 0) -> Tensor:
    """`random_bits` of groundwork/deterministic/counter_rng.py."""
    rest = torch.tensor([draw, iteration, int(stream)], dtype=torch.int64, device=items.device)
    counter = torch.cat((items[:, None], rest.expand(len(items), 3)), dim=1)
    return philox(counter, (seed & _MASK, (seed >> 32) & _MASK))
