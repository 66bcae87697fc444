"""Small formulas against SciPy and against their definitions."""

import math
import re

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from utils.general_utils import (
    PILtoTorch,
    build_rotation,
    get_expon_lr_func,
    inverse_sigmoid,
    safe_state,
    strip_lowerdiag,
    strip_symmetric,
)


def test_rotations_are_scipys():
    q = torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()
    np.testing.assert_allclose(build_rotation(q).numpy(), wanted, atol=1e-15)  # some roundings of values below 1
    assert torch.equal(build_rotation(torch.zeros(1, 4)), torch.eye(3)[None])


def test_upper_triangles_in_their_order():
    matrices = torch.arange(18.0).reshape(2, 3, 3)
    assert strip_lowerdiag(matrices)[1].tolist() == [9, 10, 11, 13, 14, 17]
    assert torch.equal(strip_lowerdiag(matrices), strip_symmetric(matrices))


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("RGBA", 4), ("L", 1)])
def test_pictures_become_tensors(mode, channels):
    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 256, (20, 30, 4), dtype=np.uint8)).convert(mode)
    image = PILtoTorch(picture, (15, 11))
    assert image.shape == (channels, 11, 15) and image.dtype == torch.float32
    wanted = np.asarray(picture.resize((15, 11)), dtype=np.float32).reshape(11, 15, channels) / 255
    np.testing.assert_array_equal(image.numpy(), wanted.transpose(2, 0, 1))
    same = PILtoTorch(picture, picture.size)
    assert torch.equal((same * 255).round().to(torch.uint8).permute(1, 2, 0).squeeze(), torch.tensor(np.array(picture)))


def test_inverse_sigmoid():
    x = torch.linspace(0.01, 0.99, 50, dtype=torch.float64)
    torch.testing.assert_close(torch.sigmoid(inverse_sigmoid(x)), x)


SECOND = 1.6e-4 * math.exp(math.log(0.01) / 30000)
DELAYED = 0.1 * (0.2 + 0.8 * math.sin(math.pi / 4))


@pytest.mark.parametrize(
    ("arguments", "rates"),
    [
        ((1.6e-4, 1.6e-6, 0, 1, 30000), {-1: 0, 0: 1.6e-4, 1: SECOND, 15000: 1.6e-5, 30000: 1.6e-6, 40000: 1.6e-6}),
        ((0.1, 0.1, 100, 0.2, 1000), {0: 0.02, 50: DELAYED, 100: 0.1, 500: 0.1}),
        ((0.0, 0.0, 0, 1, 10), {0: 0, 5: 0, 10: 0, 20: 0}),
        # Linear: powers would switch a rate off that begins or ends at zero.
        ((0.1, 0.0, 0, 1, 10), {0: 0.1, 5: 0.05, 10: 0, 20: 0}),
        ((0.0, 0.1, 0, 1, 10), {0: 0, 5: 0.05, 10: 0.1, 20: 0.1}),
    ],
)
def test_learning_rates(arguments, rates):
    rate = get_expon_lr_func(*arguments)
    assert {step: rate(step) for step in rates} == pytest.approx(rates, rel=1e-12, abs=0)


def test_stdout_lines_are_stamped_once_and_seeds_set(capsys):
    safe_state(False, 5)
    safe_state(False, 5)
    first = torch.rand(1), np.random.rand()
    print("one\ntwo")
    safe_state(True, 5)
    print("unheard")
    assert (torch.rand(1), np.random.rand()) == first
    said = capsys.readouterr().out
    assert re.fullmatch(r"one \[\d\d/\d\d \d\d:\d\d:\d\d\]\ntwo \[\d\d/\d\d \d\d:\d\d:\d\d\]\n", said)
