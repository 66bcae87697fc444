"""Small formulas against SciPy and against their definitions."""

import math
import re
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from utils.general_utils import (
    build_rotation,
    build_scaling_rotation,
    get_expon_lr_func,
    inverse_sigmoid,
    safe_state,
    strip_symmetric,
)


def test_rotations_are_scipys():
    q = torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()
    np.testing.assert_allclose(build_rotation(q).numpy(), wanted, atol=1e-15)  # some roundings of values below 1
    assert torch.equal(build_rotation(torch.zeros(1, 4)), torch.eye(3)[None])


def test_covariance_from_scales_and_rotations():
    g = torch.Generator().manual_seed(1)
    q, s = torch.randn(20, 4, dtype=torch.float64, generator=g), torch.rand(20, 3, dtype=torch.float64, generator=g)
    factor = build_scaling_rotation(s, q)
    R = Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()
    wanted = np.einsum("nij,nj,nkj->nik", R, s.numpy() ** 2, R)
    packed = strip_symmetric(factor @ factor.transpose(1, 2)).numpy()
    np.testing.assert_allclose(packed, wanted[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], atol=1e-15)


def test_inverse_sigmoid():
    x = torch.linspace(0.01, 0.99, 50, dtype=torch.float64)
    torch.testing.assert_close(torch.sigmoid(inverse_sigmoid(x)), x)


def test_learning_rate_curve():
    rate = get_expon_lr_func(1.6e-4, 1.6e-6, max_steps=30000)
    assert rate(0) == pytest.approx(1.6e-4, rel=1e-12)
    assert rate(1) == pytest.approx(1.6e-4 * math.exp(math.log(0.01) / 30000), rel=1e-12)
    assert rate(15000) == pytest.approx(1.6e-5, rel=1e-12)
    assert rate(30000) == rate(40000) == pytest.approx(1.6e-6, rel=1e-12)
    assert rate(-1) == 0


def test_learning_rate_delay_and_zero_rates():
    rate = get_expon_lr_func(0.1, 0.1, lr_delay_steps=100, lr_delay_mult=0.2, max_steps=1000)
    assert rate(0) == pytest.approx(0.02)
    assert rate(50) == pytest.approx(0.1 * (0.2 + 0.8 * math.sin(math.pi / 4)))
    assert rate(100) == rate(500) == pytest.approx(0.1)
    assert {get_expon_lr_func(0.0, 0.0, max_steps=10)(t) for t in (0, 5, 10, 20)} == {0.0}
    half = get_expon_lr_func(0.1, 0.0, max_steps=10)
    assert (half(0), half(5), half(10)) == (pytest.approx(0.1), 0.0, 0.0)


def test_stdout_lines_are_stamped_once_and_seeds_set(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # put back afterwards
    safe_state(False, 5)
    safe_state(False, 5)
    first = torch.rand(1), np.random.rand()
    print("one\ntwo")
    safe_state(True, 5)
    print("unheard")
    assert (torch.rand(1), np.random.rand()) == first
    said = capsys.readouterr().out
    assert re.fullmatch(r"one \[\d\d/\d\d \d\d:\d\d:\d\d\]\ntwo \[\d\d/\d\d \d\d:\d\d:\d\d\]\n", said)
