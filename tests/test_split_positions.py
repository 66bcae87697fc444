"""The operator that places the children of a split: the bits of the same formulas written in torch."""

import math

import numpy as np
import portable_formulas
import pytest
import torch
from diff_gaussian_rasterization.density import split_positions
from rasterizer_tools import CPU_AND_GPU
from scipy import stats
from torch import Tensor

from groundwork.deterministic.counter_rng import Stream, random_bits

WHERE = {"seed": 3, "stream": Stream.SPLIT, "iteration": 600, "draw": 1}


def _parents(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Parents of all sizes, some with a quaternion of zero, and their indices."""
    generator = torch.Generator().manual_seed(seed)
    means, scales, rotations = (torch.randn(count, width, generator=generator) for width in (3, 3, 4))
    rotations[::7] = 0
    items = torch.randint(0, 2**32, (count,), generator=generator)
    return 100 * means, 12 * scales - 4, rotations, items


def _normal(seed: int, stream: Stream, iteration: int, items: Tensor, draw: int) -> Tensor:
    """Box and Muller 1958, with NumPy's square root: torch's is sometimes off by a unit in the last place."""
    bits = random_bits(seed, stream, iteration, items, draw)
    square = portable_formulas.log((bits[:, 0::2] + 1).to(torch.float64) * 2.0**-32) * -2.0
    radius = torch.from_numpy(np.sqrt(square.numpy()))
    cos, sin = portable_formulas.cos_sin_turns(bits[:, 1::2])
    return torch.cat((radius * cos, radius * sin), dim=1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    (ax, ay, az), (bx, by, bz) = a.unbind(1), b.unbind(1)
    return torch.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), dim=1)


def _in_torch(means: Tensor, log_scales: Tensor, rotations: Tensor, items: Tensor, **where: int) -> Tensor:
    """mu + e + 2 w (u x e) + 2 u x (u x e), for the unit quaternion (w, u): every product rounded, in this order."""
    vector = _normal(where["seed"], where["stream"], where["iteration"], items, where["draw"])[:, :3]
    vector = vector * portable_formulas.exp(log_scales)
    square = (rotations * rotations.double()).unbind(1)
    length = np.sqrt((((square[0] + square[1]) + square[2]) + square[3]).numpy())
    unit = rotations.double() / torch.from_numpy(length).clamp_min(1e-12)[:, None]
    w, u = unit[:, :1], unit[:, 1:]
    twice = _cross(u, vector) * 2.0
    return (means.double() + ((vector + w * twice) + _cross(u, twice))).float()


@CPU_AND_GPU
@pytest.mark.parametrize("count", [0, 1, 1023, 40_000])
def test_the_bits_are_those_of_torch(count, device):
    parents = _parents(count)
    for where in (WHERE, {"seed": 2**63 + 5, "stream": 0, "iteration": 2**32 - 1, "draw": 0}):
        expected = _in_torch(*parents, **where)
        got = split_positions(*(t.to(device) for t in parents), **where)
        assert got.shape == (count, 3) and torch.equal(got.cpu(), expected)
        again = split_positions(*(t.to(device) for t in parents), **where | {"seed": where["seed"] + 2**64})
        assert torch.equal(again, got)


@CPU_AND_GPU
def test_broken_parents_harm_nobody_else(device):
    parents = [t.to(device) for t in _parents(6)]
    expected = split_positions(*parents, **WHERE)
    parents[0][1, 2], parents[1][2, 0], parents[2][3, 1] = math.nan, math.nan, math.nan
    parents[1][4] = torch.tensor([math.inf, -math.inf, 0.0], device=device)
    got = split_positions(*parents, **WHERE)
    assert torch.equal(got[[0, 5]], expected[[0, 5]]) and torch.equal(got[1, :2], expected[1, :2])
    assert got[1, 2].isnan() and got[2].isnan().any() and got[3].isnan().all() and not got[4].isnan().any()


def test_children_are_normal_about_their_parent_and_independent():
    count = 50_000
    upright = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    zeros = torch.zeros(count, 3)
    values = split_positions(zeros, zeros, upright, torch.arange(count), **WHERE).numpy()
    # The numbers are fixed, so the p-value is a constant; a value below 1e-3 would mean a fault.
    assert stats.kstest(values.ravel(), "norm").pvalue > 1e-3
    correlation = np.corrcoef(values.T) - np.eye(3)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(count)  # 4.5 standard errors of 3 correlations
