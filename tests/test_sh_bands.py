"""The bound of cut SH bands holds in every direction, and is attained."""

import pytest
import torch

from scene.gaussians.sh_bands import cut_bounds, needed_degree
from utils.sh_utils import eval_sh


def _colors(degree: int, rest: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """The part, (M, N, 3), of band 1 and above in the colours of N Gaussians seen along M directions."""
    features = torch.cat([rest.new_zeros(len(rest), 1, 3), rest], dim=1).transpose(1, 2)
    return torch.stack([eval_sh(degree, features, direction.expand(len(rest), 3)) for direction in directions])


def _directions(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_bound_holds(degree):
    generator = torch.Generator().manual_seed(degree)
    rest = torch.randn(50, (degree + 1) ** 2 - 1, 3, generator=generator, dtype=torch.float64)
    bounds = cut_bounds(rest)
    assert len(bounds) == degree + 1 and bounds[-1] == 0 and bounds == sorted(bounds, reverse=True)
    directions = _directions(300)
    whole = _colors(degree, rest, directions)
    for kept in range(degree):
        cut = rest.clone()
        cut[:, (kept + 1) ** 2 - 1 :] = 0
        moved = (whole - _colors(degree, cut, directions)).abs().max().item()
        assert 0.3 * bounds[kept] < moved <= bounds[kept]


@pytest.mark.parametrize("band", [1, 2, 3])
def test_the_bound_is_reached(band):
    """Coefficients equal to the basis functions in one direction attain it (equality in Cauchy-Schwarz)."""
    direction = _directions(1)
    rest = torch.zeros(1, 15, 3, dtype=torch.float64)
    for k in range(band**2 - 1, (band + 1) ** 2 - 1):
        unit = torch.zeros_like(rest)
        unit[0, k] = 1.0
        rest[0, k, 1] = _colors(3, unit, direction)[0, 0, 1]
    moved = _colors(3, rest, direction).abs().max().item()
    assert moved > 0.1
    # eval_sh's constants have 16 digits.
    assert cut_bounds(rest)[band - 1] == pytest.approx(moved, rel=1e-12)


def test_the_degree_needed():
    rest = torch.zeros(7, 15, 3)
    assert cut_bounds(rest) == [0, 0, 0, 0] and needed_degree(cut_bounds(rest), 0.0) == 0
    rest[4, 5, 2] = 0.5  # band 2
    bounds = cut_bounds(rest)
    assert bounds[0] == bounds[1] > 0.3 and bounds[2] == 0
    assert [needed_degree(bounds, tolerance) for tolerance in (0.0, 0.3, 0.4)] == [2, 2, 0]
    assert cut_bounds(torch.zeros(3, 0, 3)) == [0] and needed_degree([0.0], 0.0) == 0
    assert cut_bounds(torch.zeros(0, 8, 3)) == [0, 0, 0]
