"""The counter generator: it gives Philox's published answers and depends on nothing but its arguments."""

import numpy as np
import pytest
import torch
from scipy import stats

from splatting.deterministic import portable_math
from splatting.deterministic.counter_rng import Stream, normal, permutation, philox, random_bits, uniform

F = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [  # known answers published with Random123
        ([0] * 4, (0, 0), [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([F] * 4, (F, F), [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            (0xA4093822, 0x299F31D0),
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_philox_gives_the_published_answers(counter, key, answer):
    assert philox(torch.tensor([counter]), key)[0].tolist() == answer


def test_numbers_depend_on_the_item_not_on_the_batch():
    together = normal(5, Stream.SPLIT, 700, torch.arange(1000), 1)
    alone = normal(5, Stream.SPLIT, 700, torch.tensor([123]), 1)
    assert torch.equal(together[123:124], alone)


def test_every_argument_matters():
    items = torch.arange(64)
    base = random_bits(1, Stream.SPLIT, 10, items, 0)
    for other in (
        random_bits(2, Stream.SPLIT, 10, items, 0),
        random_bits(1 + 2**32, Stream.SPLIT, 10, items, 0),
        random_bits(1, Stream.BACKGROUND, 10, items, 0),
        random_bits(1, Stream.SPLIT, 11, items, 0),
        random_bits(1, Stream.SPLIT, 10, items, 1),
        random_bits(1, Stream.SPLIT, 10, items + 64, 0),
    ):
        assert not (base == other).any(dim=1).all()


def test_normal_numbers_are_normal_and_independent():
    values = normal(0, Stream.SPLIT, 600, torch.arange(50_000)).numpy()
    # The numbers are fixed, so the p-value is a constant; a value below 1e-3 would mean a fault.
    assert stats.kstest(values.ravel(), "norm").pvalue > 1e-3
    correlation = np.corrcoef(values.T) - np.eye(4)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(50_000)  # 4.5 standard errors of 6 correlations


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
    cos, sin = portable_math.cos_sin_turns(turns)
    # NumPy's argument, up to 2 pi, is rounded by 2^-53 of itself: 7e-16 of the angle.
    assert np.abs(cos.numpy() - np.cos(angle)).max() < 2e-15
    assert np.abs(sin.numpy() - np.sin(angle)).max() < 2e-15
