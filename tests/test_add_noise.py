"""The operator that moves Gaussians at random: the bits of its formulas written in torch, and its distribution."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.density import add_noise_
from rasterizer_tools import CPU_AND_GPU
from test_split_positions import _cross, _normal
from torch import Tensor

from splatting.deterministic import portable_math
from splatting.deterministic.counter_rng import Stream

WHERE = {"seed": 3, "stream": Stream.NOISE, "iteration": 600}
GATE = {"size": 80.0, "steepness": 100.0, "threshold": 0.005}


def _gaussians(count: int, seed: int = 0) -> list[Tensor]:
    """Gaussians of all sizes and opacities."""
    generator = torch.Generator().manual_seed(seed)
    means, scales, rotations, logits = (torch.randn(count, width, generator=generator) for width in (3, 3, 4, 1))
    rotations[::7] = 0
    return [means, 3 * scales - 4, rotations, 4 * logits - 3]


def _turned(unit: Tensor, vector: Tensor) -> Tensor:
    w, u = unit[:, :1], unit[:, 1:]
    twice = _cross(u, vector) * 2.0
    return (vector + w * twice) + _cross(u, twice)


def _in_torch(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, size, steepness, threshold, **where
):
    """mu + size g R S^2 R^T n: every product rounded, in this order."""
    opacity = 1.0 / (1.0 + portable_math.exp(-logits))
    gate = size / (1.0 + portable_math.exp(steepness * (opacity - threshold)))
    numbers = _normal(where["seed"], where["stream"], where["iteration"], torch.arange(len(means)), 0)[:, :3]
    square = (rotations * rotations.double()).unbind(1)
    length = np.sqrt((((square[0] + square[1]) + square[2]) + square[3]).numpy())
    unit = rotations.double() / torch.from_numpy(length).clamp_min(1e-12)[:, None]
    own = _turned(unit * torch.tensor([1.0, -1.0, -1.0, -1.0]), numbers)
    return (means.double() + gate * _turned(unit, own * portable_math.exp(2.0 * log_scales.double()))).float()


@CPU_AND_GPU
@pytest.mark.parametrize("count", [0, 1, 1023, 40_000])
def test_the_bits_are_those_of_torch(count, device):
    """Also where the operator sees beforehand that nothing will change."""
    gaussians = _gaussians(count)
    for gate in (GATE, GATE | {"size": 1e-3, "steepness": 1e4}, GATE | {"size": 1e4, "threshold": 0.1}):
        wanted = _in_torch(*gaussians, **gate, **WHERE)
        got = [t.clone().to(device) for t in gaussians]
        add_noise_(*got, **gate, **WHERE)
        assert torch.equal(got[0].cpu(), wanted)
        assert count < 1000 or 0.02 < (wanted != gaussians[0]).any(dim=1).float().mean() < 0.999


def test_every_argument_matters():
    gaussians = _gaussians(500)
    gaussians[3][:] = -5.0

    def moved(**changes: float) -> Tensor:
        means = gaussians[0].clone()
        add_noise_(means, *gaussians[1:], **GATE | WHERE | changes)
        return means

    base = moved()
    for name, value in (GATE | WHERE).items():
        assert not torch.equal(base, moved(**{name: value + 1})), name
    assert torch.equal(base, moved(seed=3 + 2**64)) and torch.equal(moved(size=0.0), gaussians[0])


def test_a_part_of_the_gaussians_gets_the_noise_of_the_whole():
    gaussians = _gaussians(500)
    part = [values[200:].clone() for values in gaussians]
    add_noise_(*gaussians, **GATE, **WHERE)
    add_noise_(*part, **GATE, **WHERE, first=200)
    assert torch.equal(part[0], gaussians[0][200:])


@CPU_AND_GPU
def test_a_guard_that_has_stopped_keeps_the_means(device):
    gaussians = [t.to(device) for t in _gaussians(50)]
    before, stopped = gaussians[0].clone(), torch.tensor([7], device=device)
    add_noise_(*gaussians, **GATE, **WHERE, stopped=stopped)
    assert torch.equal(gaussians[0], before)
    add_noise_(*gaussians, **GATE, **WHERE, stopped=stopped.zero_())
    assert not torch.equal(gaussians[0], before)


@CPU_AND_GPU
def test_a_mean_that_would_not_be_finite_stays(device):
    gaussians = [t.to(device) for t in _gaussians(6)]
    gaussians[3][:] = -5.0
    wanted = [t.clone() for t in gaussians]
    add_noise_(*wanted, **GATE, **WHERE)
    gaussians[1][1, 0], gaussians[2][2, 3], gaussians[3][3], gaussians[1][4] = math.nan, math.nan, math.nan, 300.0
    before = gaussians[0].clone()
    add_noise_(*gaussians, **GATE, **WHERE)
    assert torch.equal(gaussians[0][[0, 5]], wanted[0][[0, 5]])
    assert torch.equal(gaussians[0][1:5], before[1:5]) and not torch.equal(before[0], wanted[0][0])
