"""The operator that moves Gaussians at random: the bits of its formulas in NumPy, and its distance from float64."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.density import add_noise_
from rasterizer_tools import CPU_AND_GPU
from test_split_positions import _normal
from torch import Tensor

from splatting.deterministic.counter_rng import Stream, random_bits

WHERE = {"seed": 3, "stream": Stream.NOISE, "iteration": 600}
GATE = {"size": 80.0, "steepness": 100.0, "threshold": 0.005}


def _gaussians(count: int, seed: int = 0) -> list[Tensor]:
    """Gaussians of all sizes and opacities."""
    generator = torch.Generator().manual_seed(seed)
    means, scales, rotations, logits = (torch.randn(count, width, generator=generator) for width in (3, 3, 4, 1))
    rotations[::7] = 0
    return [means, 3 * scales - 4, rotations, 4 * logits - 3]


def _polynomial(x: np.ndarray, *inverses: float) -> np.ndarray:
    """By the inverses of its coefficients, highest power first."""
    result = x * 0
    for inverse in inverses:
        result = result * x + np.float32(1) / np.float32(inverse)
    return result


def _exp(x: np.ndarray) -> np.ndarray:
    """e^x in float32, every operation rounded."""
    cut = np.clip(x, -87, 88)
    exponent = np.rint(cut * np.float32(1.44269504))
    r = (cut - exponent * np.float32(0.693359375)) - exponent * np.float32(-2.12194440e-4)
    found = np.ldexp(_polynomial(r, 5040, 720, 120, 24, 6, 2, 1, 1), exponent.astype(np.int32))
    return np.where(x > 88, np.float32(np.inf), np.where(x < -87, np.float32(0), found))


def _log(x: np.ndarray) -> np.ndarray:
    mantissa, whole = np.frexp(x)
    low = mantissa < np.float32(0.70710678)
    mantissa, exponent = np.where(low, mantissa * 2, mantissa), (whole - low).astype(np.float32)
    z = (mantissa - 1) / (mantissa + 1)
    series = z * _polynomial(z * z, 4.5, 3.5, 2.5, 1.5, 0.5)
    return exponent * np.float32(0.693359375) + (exponent * np.float32(-2.12194440e-4) + series)


def _numbers(bits: np.ndarray) -> np.ndarray:
    """Normal numbers (N, 3) float32 of words (N, 4)."""
    lengths = np.sqrt(_log((bits[:, 0::2].astype(np.float32) + 1) * np.float32(2.0**-32)) * -2)
    turns = bits[:, 1::2]
    angle = (turns & 0x3FFFFFFF).astype(np.float32) * np.float32(math.pi / 2 * 2.0**-30)
    cos = _polynomial(angle * angle, 479001600, -3628800, 40320, -720, 24, -2, 1)
    sin = angle * _polynomial(angle * angle, 6227020800, -39916800, 362880, -5040, 120, -6, 1)
    odd, over = (turns >> 30) & 1 == 1, turns >> 31 == 1
    cos, sin = np.where(odd, -sin, cos), np.where(odd, cos, sin)
    cos, sin = np.where(over, -cos, cos), np.where(over, -sin, sin)
    return np.concatenate([lengths * cos, lengths * sin], 1)[:, :3]


def _turned(w: np.ndarray, u: np.ndarray, vector: np.ndarray) -> np.ndarray:
    twice = _cross(u, vector) * 2
    return (vector + w * twice) + _cross(u, twice)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    (x, y, z), (p, q, r) = a.T, b.T
    return np.stack([y * r - z * q, z * p - x * r, x * q - y * p], 1)


def _in_numpy(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, size, steepness, threshold, **where
) -> Tensor:
    """mu + size g R S^2 R^T n in float32: every operation rounded, in this order."""
    x, s, q, logit = (values.numpy() for values in (means, log_scales, rotations, logits))
    one = np.float32(1)
    opacity = one / (one + _exp(-logit))
    gate = np.float32(size) / (one + _exp(np.float32(steepness) * (opacity - np.float32(threshold))))
    numbers = _numbers(random_bits(where["seed"], where["stream"], where["iteration"], torch.arange(len(x)), 0).numpy())
    unit = np.abs(q).max(1, keepdims=True, initial=np.float32(1e-12))
    scaled = q / unit
    square = (scaled * scaled).T
    root = np.sqrt(((square[0] + square[1]) + square[2]) + square[3])[:, None]
    scaled = scaled / np.maximum(root, np.float32(1e-12) / unit)
    w, u = scaled[:, :1], scaled[:, 1:]
    own = _turned(w, -u, numbers) * _exp(2 * s)
    return torch.from_numpy(x + gate * _turned(w, u, own))


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
@pytest.mark.parametrize("count", [0, 1, 1023, 40_000])
def test_the_bits_are_those_of_numpy(count, device):
    """Also where the operator sees beforehand that nothing will change."""
    gaussians = _gaussians(count)
    for gate in (GATE, GATE | {"size": 1e-3, "steepness": 1e4}, GATE | {"size": 1e4, "threshold": 0.1}):
        wanted = _in_numpy(*gaussians, **gate, **WHERE)
        got = [t.clone().to(device) for t in gaussians]
        add_noise_(*got, **gate, **WHERE)
        assert torch.equal(got[0].cpu(), wanted)
        assert count < 1000 or 0.02 < (wanted != gaussians[0]).any(dim=1).float().mean() < 0.999


def test_the_noise_is_that_of_float64_to_rounding():
    """Also of quaternions so long or short that their squares are no floats."""
    gaussians = _gaussians(40_000)
    gaussians[2][1::7] *= 1e30
    gaussians[2][2::7] *= 1e-8
    gaussians[0].zero_()
    wanted, deviation = _exactly(*gaussians, **GATE, **WHERE)
    add_noise_(*gaussians, **GATE, **WHERE)
    kept = deviation > 1e-30  # below it, floats have fewer digits
    assert 0.2 < kept.float().mean() < 0.9
    error = (gaussians[0] - wanted).norm(dim=1) / deviation
    assert error[kept].max() < 1e-4 and error[kept].median() < 1e-6


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
