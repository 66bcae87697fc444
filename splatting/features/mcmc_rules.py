"""Rules of the strategy mcmc (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians that nobody sees move to others. Such a target is divided into equal parts, which lie in the same place and
together look as the target did. What decides rows is computed in float64, by operations that every device and number of
threads rounds in the same way, and sums are of integers.
"""

import math

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.density import add_noise_
from torch import Tensor

from groundwork.deterministic.counter_rng import Stream, random_bits
from groundwork.deterministic.portable_math import exp, log
from groundwork.ranks.rows import WHOLE, Shards, changes_rows
from scene.gaussians.adc import append_rows
from scene.gaussians.density_rules import logit
from scene.gaussians.parameters import GaussianParameters

MOST_PARTS = 51  # for which a divided Gaussian is corrected (paper): itself and 50 copies
GATE_STEEPNESS = 100.0  # k of the paper's factor sigmoid(-k (o - t)) of the noise
GATE_OPACITY = 0.005  # t of that: the opacity o with half of the noise
_UNITS = 2**24  # of opacity 1, where Gaussians are drawn in proportion to it
_MOST_LOGIT = 40.0  # an opacity of 1 - 4e-18; beyond, the sum of `_weight` would lose its digits
_RELOCATION, _GROWTH = range(2)  # draws of one iteration


def start_as(gaussians: GaussianParameters, opacity: float, scale: float) -> None:
    """Give all Gaussians an opacity, and multiply their scales. Call it before the first step."""
    with torch.no_grad():
        logits = torch.full_like(gaussians.raw("opacity"), logit(opacity))
        log_scales = gaussians.log_scales() + math.log(scale)
        for name, values in gaussians.raw_shapes(logits, log_scales).items():
            gaussians.raw(name).copy_(values)


def is_alive(gaussians: GaussianParameters, min_opacity: float) -> Tensor:
    """Return a mask of the Gaussians that `relocate` leaves where they are, (N,) bool."""
    return gaussians.opacity_logits().reshape(-1) > logit(min_opacity)


def relocate(gaussians: GaussianParameters, min_opacity: float, *, seed: int, iteration: int) -> int:
    """Move the Gaussians of an opacity <= min_opacity to others, drawn in proportion to the opacity of these.

    A target and the Gaussians that have come to it become equal parts of the former target, up to MOST_PARTS. Adam's
    averages of all of them restart at zero. Return the number of Gaussians to move; if all would have to move, nothing
    changes.

    seed, iteration: decide the random numbers.
    """
    live = is_alive(gaussians, min_opacity)
    dead = (~live).nonzero().reshape(-1)
    counts = gaussians.shards.ranks.all_gather_host_ints(len(dead))[:, 0]
    count = int(counts.sum())
    if 0 < count < gaussians.gaussian_count:
        draws, origins = _draw_and_shrink(gaussians, live, count, seed, iteration, _RELOCATION)
        rows = gaussians.rows_at(origins)
        gaussians.table.overwrite(dead, gaussians.shards.send_draws(rows, draws, counts))
    return count


@changes_rows
def grow(gaussians: GaussianParameters, count: int, *, seed: int, iteration: int) -> None:
    """Append `count` Gaussians, which are parts of others as `relocate` makes them."""
    every = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.raw("xyz").device)
    draws, origins = _draw_and_shrink(gaussians, every, count, seed, iteration, _GROWTH)
    append_rows(gaussians, gaussians.rows_at(origins), origins)
    gaussians.shards.order_appended(draws)


@torch.no_grad()
def add_noise(gaussians: GaussianParameters, size: float, *, seed: int, iteration: int) -> None:
    """Move every centre by size g C n: its covariance C, standard normal n, the factor g of its opacity.

    Nothing moves once a guard holds steps back.

    seed, iteration: decide n.
    """
    shapes = gaussians.log_scales(), gaussians.raw("rotation"), gaussians.opacity_logits()
    gate = {"size": size, "steepness": GATE_STEEPNESS, "threshold": GATE_OPACITY}
    numbers = {"seed": seed, "stream": Stream.NOISE, "iteration": iteration}
    guard = getattr(gaussians.optimizer, "guard", None)
    where = {"stopped": guard.stopped if guard else None, "first": gaussians.shards.first}
    add_noise_(gaussians.raw("xyz"), *shapes, **gate, **numbers, **where)


def _draw_and_shrink(
    gaussians: GaussianParameters, live: Tensor, count: int, seed: int, iteration: int, which: int
) -> tuple[Tensor, Tensor]:
    """Draw Gaussians that become several, and shrink each of them to one of its equal parts.

    Return the draws (n,) that fell on this rank's Gaussians, ascending, and the rows (n,) that they fell on.

    live: (N,) bool, the Gaussians that may be drawn, in proportion to their opacity.
    count: number of draws over all ranks, one for each new part.
    which: _RELOCATION or _GROWTH, for which the random numbers differ.
    """
    logits = gaussians.opacity_logits().reshape(-1)
    units = torch.where(live, opacity_units(logits), 0)
    numbers = {"seed": seed, "iteration": iteration, "draw": which}
    draws, origins = draw(units, count, **numbers, shards=gaussians.shards)
    sources, copies = origins.unique(return_counts=True)
    opacities, larger = divided(logits[sources], (copies + 1).clamp_max(MOST_PARTS))
    log_scales = gaussians.log_scales()[sources] + larger[:, None]
    gaussians.table.overwrite(sources, gaussians.raw_shapes(opacities[:, None].float(), log_scales.float()))
    return draws, origins


def opacity_units(logits: Tensor) -> Tensor:
    """Return opacities as whole numbers of 2^-24, at least 1: (N,) int64.

    logits: (N,).
    """
    return (_UNITS / (1.0 + exp(-logits.nan_to_num()))).to(torch.int64).clamp_min(1)


def draw(
    units: Tensor, count: int, *, seed: int, iteration: int, draw: int, shards: Shards = WHOLE
) -> tuple[Tensor, Tensor]:
    """Draw `count` times with replacement among all rows, in proportion to `units`.

    Return the draws that fell on this process's items, (n,) ascending, and the items drawn, (n,).

    units: (N,) whole numbers, of a sum above 0.
    seed, iteration, draw: decide the random numbers.
    """
    ends = units.cumsum(0)
    items = torch.arange(count, device=units.device)
    bits = random_bits(seed, Stream.RELOCATION, iteration, items, draw)
    share = ((bits[:, 0] >> 5) << 26 | bits[:, 1] >> 6).to(torch.float64) * 2.0**-53
    if shards is WHOLE:
        tickets = (share * ends[-1]).to(torch.int64)
        return items, torch.searchsorted(ends, torch.minimum(tickets, ends[-1] - 1), right=True)
    own = int(units.sum())
    below, total = shards.ranks.offset_and_total(own)
    tickets = (share * total).to(torch.int64).clamp_max(total - 1) - below
    mine = ((tickets >= 0) & (tickets < own)).nonzero().reshape(-1)
    return mine, torch.searchsorted(ends, tickets[mine], right=True)


def divided(logits: Tensor, parts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the opacity logits (n,) of equal parts of Gaussians, and the changes of their log scales (n,).

    Results are float64. With N parts, the opacity o becomes p = 1 - (1 - o)^(1/N), and scales are multiplied by o /
    sum_{k=1..N} C(N, k) (-1)^(k+1) p^k / sqrt(k) (the paper's rule of relocation; its double sum, with the inner
    binomials added up). So the parts together are as opaque in the middle as the one Gaussian was, and hide as much in
    total along any line through the middle.

    logits: (n,), of the Gaussians before.
    parts: (n,) int64, from 1 to MOST_PARTS.
    """
    before = logits.to(torch.float64).clamp_max(_MOST_LOGIT)
    depth = _softplus(before) / parts  # -ln(1 - p)
    log_opacity = log(1.0 - exp(-depth))
    return log_opacity + depth, -_softplus(-before) - log(_weight(exp(log_opacity), parts))


def _weight(opacity: Tensor, parts: Tensor) -> Tensor:
    """Return the sum of `divided` for opacities p (n,)."""
    table = _make_coefficients().to(opacity.device)
    total = torch.zeros_like(opacity)
    for coefficients in table.flip(0):  # Horner's scheme, product and sum rounded one by one
        total = (total + coefficients[parts]) * opacity
    return total


def _make_coefficients() -> Tensor:
    """Return C(N, k) (-1)^(k+1) / sqrt(k) in row k - 1 and column N, float64."""
    rows = [
        [math.comb(parts, k) * (-1) ** (k + 1) / math.sqrt(k) for parts in range(MOST_PARTS + 1)]
        for k in range(1, MOST_PARTS + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _softplus(x: Tensor) -> Tensor:
    """Return ln(1 + e^x), float64."""
    return x.clamp_min(0.0) + log(1.0 + exp(-x.abs()))
