"""Rounding along the backward's pass from back to front.

The backward computes each splat's transmittance by dividing the one behind it by 1 - alpha, on a GPU with an
approximate reciprocal. If that were biased, the error would grow with the number of splats.
"""

import math

import pytest
import torch
from rasterizer_tools import CPU_AND_GPU, gradients
from torch import Tensor

from benchmarks.workloads.splat_scenes import settings

SIZE = 48
# The bound on the error of a division: three times the largest error of dLoss/dalpha that exact division gives in
# float32 after 1,862 blends (measured on other data), divided by the number of blends.
PER_DIVISION = 3 * 3e-6 / 1862


def stack(n: int, least: float, most: float) -> dict[str, Tensor]:
    """Wide splats, one behind the other, that cover the image and have opacities in the given range."""
    g = torch.Generator().manual_seed(12)
    depth = 1 + torch.arange(n) / n
    focal = SIZE / (2 * math.tan(math.radians(30)))
    off_axis = 8 / focal * torch.randn(n, 2, generator=g)
    return {
        "means": torch.cat([off_axis, torch.ones(n, 1)], 1) * depth[:, None],
        "opacities": least + (most - least) * torch.rand(n, 1, generator=g),
        "scales": 60 / focal * depth[:, None].repeat(1, 3),
        "rotations": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        "colors": torch.rand(n, 3, generator=g),
    }


@CPU_AND_GPU
# A pixel takes about this many before it is opaque: fainter splats are not blended, denser ones end it sooner.
@pytest.mark.parametrize(("n", "least", "most"), [(900, 0.006, 0.011), (250, 0.02, 0.04)])
def test_divisions_have_no_bias(n, least, most, device):
    parameters, rest = stack(n, least, most), {"loss": lambda out: out.color.sum(), "raw": False}
    got = gradients(parameters, settings(SIZE, SIZE, torch.float32), device, **rest)
    wanted = gradients({name: t.double() for name, t in parameters.items()}, settings(SIZE, SIZE), **rest)
    assert 1.5e-4 < wanted["transmittance"].min() < wanted["transmittance"].max() < 0.01  # no splat is left out
    # A colour's gradient is the sum of alpha T over the pixels. At the front, T is 1 after n divisions. Rounding errors
    # have either sign, so they almost vanish in the mean over pixels and splats; a bias would not.
    name, front = "d colors", n // 10
    relative = (got[name].double() / wanted[name] - 1)[:, 0]
    drift = relative[:front].mean().item() / (n - front / 2)
    print(f"{device}, {n} splats: mean signed error per division {drift:.1e} = {drift * 2**23:+.4f} units of 2^-23")
    assert abs(drift) <= PER_DIVISION
