"""The operator that moves Gaussians at random: its distance from float64, and what it leaves alone."""

import math

import pytest
import torch
from diff_gaussian_rasterization.density import add_noise_
from rasterizer_tools import CPU_AND_GPU
from test_split_positions import _normal
from torch import Tensor

from groundwork.deterministic.counter_rng import Stream

WHERE = {"seed": 3, "stream": Stream.NOISE, "iteration": 600}
GATE = {"size": 80.0, "steepness": 100.0, "threshold": 0.005}


def _gaussians(count: int, seed: int = 0) -> list[Tensor]:
    """Gaussians of all sizes and opacities."""
    generator = torch.Generator().manual_seed(seed)
    means, scales, rotations, logits = (torch.randn(count, width, generator=generator) for width in (3, 3, 4, 1))
    rotations[::7] = 0
    return [means, 3 * scales - 4, rotations, 4 * logits - 3]


def _exactly(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, size, steepness, threshold, **where
) -> tuple[Tensor, Tensor]:
    """The same noise (N, 3) in float64, without the means, and its largest standard deviation (N,)."""
    gate = size / (1 + (steepness * (torch.sigmoid(logits.double()) - threshold)).exp())
    numbers = _normal(where["seed"], where["stream"], where["iteration"], torch.arange(len(means)), 0)[:, :3, None]
    w, x, y, z = (rotations.double() / rotations.double().norm(dim=1, keepdim=True).clamp_min(1e-12)).unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    turn = torch.stack(rows, 1).view(-1, 3, 3)
    variances = (2 * log_scales.double()).exp()
    moved = gate * (turn @ (variances[:, :, None] * (turn.mT @ numbers)))[:, :, 0]
    return moved, gate[:, 0] * variances.amax(1)


@CPU_AND_GPU
@pytest.mark.parametrize("more", [{}, {"size": 1e-3, "steepness": 1e4}, {"size": 1e4, "threshold": 0.1}])
def test_the_noise_is_that_of_float64_to_rounding_and_has_the_same_bits_everywhere(more, device):
    """Also of quaternions so long or short that their squares are no floats, and where nothing will change."""
    gaussians, gate = _gaussians(40_000), GATE | more
    gaussians[2][1::7] *= 1e30
    gaussians[2][2::7] *= 1e-8
    wanted, deviation = _exactly(*gaussians, **gate, **WHERE)
    got, still = ([t.clone().to(device) for t in gaussians] for _ in range(2))
    add_noise_(*got, **gate, **WHERE)
    moved = (got[0].cpu() != gaussians[0]).any(dim=1)
    assert 0.02 < moved.float().mean() < 0.999
    for values in (still, gaussians):
        values[0].zero_()
        add_noise_(*values, **gate, **WHERE)
    assert torch.equal(still[0].cpu(), gaussians[0])
    kept = deviation > 1e-30 * gate["size"]  # below it, floats have fewer digits
    assert 0.05 < kept.float().mean() < 0.95
    error = (gaussians[0] - wanted).norm(dim=1) / deviation
    assert error[kept].max() < 1e-4 and error[kept].median() < 1e-6
    add_noise_(*(t[:0] for t in gaussians), **gate, **WHERE)


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
