"""Rules of relocation (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo") on raw parameters.

A Gaussian is divided into several that lie in the same place and together look as it did. Some of the parts take the
place of Gaussians that nobody sees. Everything is computed in float64 by operations that every device and number of
threads rounds in the same way, and sums are of integers.
"""

import math

import torch
from torch import Tensor

from splatting.deterministic.counter_rng import Stream, random_bits
from splatting.deterministic.portable_math import exp, log
from splatting.distributed.ranks import ALONE, Ranks

MOST_PARTS = 51  # of one Gaussian (paper): itself and 50 copies
_UNITS = 2**24  # of opacity 1, where Gaussians are drawn in proportion to it
_MOST_LOGIT = 40.0  # an opacity of 1 - 4e-18; beyond, the sum of `_weight` would lose its digits


def opacity_units(logits: Tensor) -> Tensor:
    """Opacities (N,) as whole numbers of 2^-24, at least 1, from logits (N,): int64."""
    return (_UNITS / (1.0 + exp(-logits.nan_to_num()))).to(torch.int64).clamp_min(1)


def draw(
    units: Tensor, count: int, *, seed: int, iteration: int, draw: int, ranks: Ranks = ALONE
) -> tuple[Tensor, Tensor]:
    """`count` draws with replacement among all ranks, in proportion to `units` (N,), whole numbers of a sum above 0.

    Returns which of the draws, (n,) ascending, fell on this rank's items, and on which of them, (n,). seed, iteration
    and draw decide the random numbers.
    """
    ends = units.cumsum(0)
    items = torch.arange(count, device=units.device)
    bits = random_bits(seed, Stream.RELOCATION, iteration, items, draw)
    share = ((bits[:, 0] >> 5) << 26 | bits[:, 1] >> 6).to(torch.float64) * 2.0**-53
    if not ranks.several:
        tickets = (share * ends[-1]).to(torch.int64)
        return items, torch.searchsorted(ends, torch.minimum(tickets, ends[-1] - 1), right=True)
    own = int(units.sum())
    below, total = ranks.before(own)
    tickets = (share * total).to(torch.int64).clamp_max(total - 1) - below
    mine = ((tickets >= 0) & (tickets < own)).nonzero().reshape(-1)
    return mine, torch.searchsorted(ends, tickets[mine], right=True)


def divided(logits: Tensor, parts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity logits (n,) of each of `parts` equal parts of a Gaussian, and what is added to its log scales (n,).

    logits: (n,) of the Gaussians before; parts: (n,) int64 from 1 to MOST_PARTS. Returns float64. With N parts, the
    opacity o becomes p = 1 - (1 - o)^(1/N), and scales are multiplied by o / sum_{k=1..N} C(N, k) (-1)^(k+1) p^k /
    sqrt(k) (the paper's rule of relocation; its double sum, with the inner binomials added up). So in the
    middle the parts together are as opaque as the one was, and along any line through it they hide as much in total.
    """
    before = logits.to(torch.float64).clamp_max(_MOST_LOGIT)
    depth = _softplus(before) / parts  # -ln(1 - p)
    log_opacity = log(1.0 - exp(-depth))
    return log_opacity + depth, -_softplus(-before) - log(_weight(exp(log_opacity), parts))


def _weight(opacity: Tensor, parts: Tensor) -> Tensor:
    """The sum of `divided` for opacities p (n,)."""
    table = _coefficients().to(opacity.device)
    total = torch.zeros_like(opacity)
    for coefficients in table.flip(0):  # Horner's scheme, product and sum rounded one by one
        total = (total + coefficients[parts]) * opacity
    return total


def _coefficients() -> Tensor:
    """C(N, k) (-1)^(k+1) / sqrt(k) in row k - 1 and column N, float64."""
    rows = [
        [math.comb(parts, k) * (-1) ** (k + 1) / math.sqrt(k) for parts in range(MOST_PARTS + 1)]
        for k in range(1, MOST_PARTS + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _softplus(x: Tensor) -> Tensor:
    """ln(1 + e^x), float64."""
    return x.clamp_min(0.0) + log(1.0 + exp(-x.abs()))
