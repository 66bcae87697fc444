"""The counter generator: it gives Philox's published answers and depends on nothing but its arguments."""

import numpy as np
import portable_formulas
import pytest
import torch
from rasterizer_tools import CPU_AND_GPU
from scipy import stats

from groundwork.deterministic import portable_math
from groundwork.deterministic.counter_rng import Stream, permutation, random_bits, uniform

F = 0xFFFFFFFF


@CPU_AND_GPU
@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [  # known answers published with Random123
        ([0] * 4, 0, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([F] * 4, F << 32 | F, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            0x299F31D0_A4093822,
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_philox_gives_the_published_answers(counter, key, answer, device):
    item, draw, iteration, stream = counter
    items = torch.tensor([item], device=device)
    assert random_bits(key, stream, iteration, items, draw)[0].tolist() == answer


@CPU_AND_GPU
def test_operators_have_the_bits_of_the_formulas(device):
    x = torch.randn(70_001, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 50
    for name in ("exp", "log"):
        wanted = getattr(portable_formulas, name)(x.abs())
        assert torch.equal(getattr(portable_math, name)(x.abs().to(device)).cpu(), wanted)
    items = torch.arange(70_001) * 6_700_417 % 2**32
    wanted = portable_formulas.random_words(2**63 + 5, Stream.SPLIT, 600, items, 1)
    assert torch.equal(random_bits(2**63 + 5, Stream.SPLIT, 600, items.to(device), 1).cpu(), wanted)


def test_uniform_numbers_fill_the_half_open_interval():
    values = uniform(0, Stream.BACKGROUND, 1, torch.arange(50_000)).numpy()
    assert values.dtype == np.float32 and values.min() >= 0 and values.max() < 1
    assert stats.kstest(values.ravel(), "uniform").pvalue > 1e-3


def test_permutations_are_whole_and_differ_by_epoch_and_seed():
    first = permutation(0, Stream.VIEW_ORDER, 0, 43)
    assert sorted(first) == list(range(43))
    assert first == permutation(0, Stream.VIEW_ORDER, 0, 43)
    assert first != permutation(0, Stream.VIEW_ORDER, 1, 43)
    assert first != permutation(1, Stream.VIEW_ORDER, 0, 43)


def test_portable_functions_agree_with_numpy():
    x = torch.linspace(-700, 700, 20_001, dtype=torch.float64)
    exp = np.exp(x.numpy())
    assert np.abs(portable_math.exp(x).numpy() / exp - 1).max() < 4 * 2.0**-53
    u = torch.logspace(-300, 300, 20_001, dtype=torch.float64)
    log = np.log(u.numpy())
    assert (np.abs(portable_math.log(u).numpy() - log) / np.maximum(1, np.abs(log))).max() < 1e-15
    turns = torch.cat((torch.arange(8) << 29, random_bits(0, Stream.SPLIT, 0, torch.arange(5000)).reshape(-1)))
    angle = turns.numpy() * (2 * np.pi / 2**32)
    cos, sin = portable_formulas.cos_sin_turns(turns)
    # NumPy's argument, up to 2 pi, is rounded by 2^-53 of itself: 7e-16 of the angle.
    assert np.abs(cos.numpy() - np.cos(angle)).max() < 2e-15
    assert np.abs(sin.numpy() - np.sin(angle)).max() < 2e-15


def test_roots_and_exponentials_of_float32_are_correctly_rounded_and_have_derivatives():
    x = torch.cat([torch.arange(1, 2**20).float(), torch.logspace(-37, 38, 200_001)])
    assert np.array_equal(portable_math.square_root(x).numpy(), np.sqrt(x.numpy()))
    y = torch.linspace(-87, 88, 200_001)
    assert np.array_equal(portable_math.exponential(y).numpy(), np.exp(y.double().numpy()).astype(np.float32))
    given = torch.linspace(0.1, 3, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(portable_math.square_root, given)
    assert torch.autograd.gradcheck(portable_math.exponential, given)
