"""Splitting along the longest axis: moments in float64, and what changes in the picture."""

import math

import pytest
import torch
from torch import Tensor

from scene.gaussians.long_axis import OVERLAP, SHIFT, SHRINK, long_axis_children
from utils.general_utils import build_scaling_rotation

EPSILON = 2.0**-23  # of the float32 numbers that a child is rounded to


def _parents(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = (3, 1.0, 0.0), (3, 1.0, -1.0), (4, 1.0, 0.0), (1, 3.0, 0.0)
    xyz, scaling, rotation, opacity = (b + a * torch.randn(count, n, generator=generator) for n, a, b in shapes)
    return xyz, scaling, rotation, opacity


def _covariance(scaling: Tensor, rotation: Tensor) -> Tensor:
    factor = build_scaling_rotation(scaling.double().exp(), rotation.double())
    return factor @ factor.transpose(1, 2)


def test_the_mixture_has_the_moments_of_the_parent():
    xyz, scaling, rotation, opacity = _parents(500)
    children = long_axis_children(xyz, scaling, rotation, opacity)
    centres = children["xyz"].double().view(2, 500, 3)
    shapes = _covariance(children["scaling"], rotation.repeat(2, 1)).view(2, 500, 3, 3)
    offsets = centres - centres.mean(dim=0)
    between = offsets[..., :, None] * offsets[..., None, :]
    size = 1 + xyz.abs().amax(dim=1).double() + scaling.amax(dim=1).double().exp()
    assert ((centres.mean(dim=0) - xyz.double()).abs().amax(dim=1) <= EPSILON * size).all()
    wanted = _covariance(scaling, rotation)
    error = ((shapes + between).mean(dim=0) - wanted).abs().amax(dim=(1, 2))
    assert (error <= 4 * EPSILON * size * size).all()
    assert ((wanted - shapes[0]).abs().amax(dim=(1, 2)) > 1e-3 * wanted.abs().amax(dim=(1, 2))).all()


def test_the_longest_axis_alone_is_cut_and_turned():
    quarter = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])  # about z: x becomes y
    scaling = torch.tensor([[0.0, -1, -2], [-1, 0.5, -2], [-3, -2, -1], [0, 0, 0], [-1, 0, 0], [0.0, -1, -2]])
    rotation = torch.tensor([1.0, 0, 0, 0]).repeat(6, 1)
    rotation[0], rotation[1], rotation[5] = quarter, 7 * quarter, 0
    zero = torch.zeros(6, 3)
    children = long_axis_children(zero, scaling, rotation, torch.zeros(6, 1))
    axes = [0, 1, 2, 0, 1, 0]
    wanted = scaling.clone()
    wanted[range(6), axes] += math.log(SHRINK)
    assert torch.equal(children["scaling"], wanted.repeat(2, 1))
    offsets = torch.zeros(6, 3)
    for row, (axis, length) in enumerate([(1, 1), (0, -math.exp(0.5)), (2, math.exp(-1)), (0, 1), (1, 1), (0, 1)]):
        offsets[row, axis] = length * SHIFT
    torch.testing.assert_close(children["xyz"], torch.cat((offsets, -offsets)), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("logit", [-12.0, -4.0, 0.0, 3.0, 15.0])
def test_the_picture_covers_as_much_as_before(logit):
    """Weights of one Gaussian and of its children seen from the side, summed over a fine grid in float64."""
    x, y = torch.meshgrid(*[torch.linspace(-6, 6, 961, dtype=torch.float64)] * 2, indexing="ij")

    def weight(where: float, length: float, opacity: float) -> Tensor:
        return opacity * torch.exp(-0.5 * (((x - where) / length) ** 2 + (y / 0.5) ** 2))

    scaling = torch.tensor([[0.0, math.log(0.5), -3]])
    unturned = torch.tensor([[1.0, 0, 0, 0]])
    children = long_axis_children(torch.zeros(1, 3), scaling, unturned, torch.tensor([[logit]]))
    parent = weight(0.0, 1.0, 1 / (1 + math.exp(-logit)))
    left, right = (
        weight(float(children["xyz"][i, 0]), float(children["scaling"][i, 0].exp()), float(c.sigmoid()))
        for i, c in enumerate(children["opacity"])
    )
    both = 1 - (1 - left) * (1 - right)
    assert float(both.sum() / parent.sum()) == pytest.approx(1, abs=2e-6)
    assert (both * x).sum().abs() < 1e-6 * parent.sum()
    faint = logit <= -4
    spread, before = (both * x * x).sum() / both.sum(), (parent * x * x).sum() / parent.sum()
    assert float(spread) == pytest.approx(float(before), rel=0.01 if faint else 0.1)
    assert (both - parent).abs().sum() < (0.13 if faint else 0.23) * parent.sum()


def test_children_of_a_wider_split_would_come_apart():
    """SHIFT is the largest: the mixture has its one maximum in the middle, and is flat there."""
    x = torch.linspace(-3, 3, 601, dtype=torch.float64)

    def mixture(shift: float) -> Tensor:
        return sum(torch.exp(-0.5 * (x - s) ** 2 / (1 - shift * shift)) for s in (shift, -shift))

    assert mixture(SHIFT).argmax() == 300 and mixture(SHIFT + 0.02).argmax() != 300
    assert pytest.approx(1) == SHIFT**2 + SHRINK**2
    assert pytest.approx(math.exp(-1)) == OVERLAP


def test_extremes_stay_finite():
    opacity = torch.tensor([[-3e38], [-800.0], [-100.0], [100.0], [3e38]])
    xyz, scaling, rotation, _ = _parents(5)
    children = long_axis_children(xyz, scaling, rotation, opacity)
    assert all(rows.isfinite().all() and rows.dtype == torch.float32 for rows in children.values())
    assert (children["opacity"][:2] < -600).all()
    assert float(children["opacity"][4].sigmoid()) == pytest.approx(0.7603, abs=1e-4)
    empty = long_axis_children(*(t[:0] for t in (xyz, scaling, rotation, opacity)))
    assert [tuple(rows.shape) for rows in empty.values()] == [(0, 3), (0, 3), (0, 1)]


def test_any_number_of_threads_gives_the_same(threads):
    parents, results = _parents(40_001), []
    for count in (1, 2, 3):
        threads(count)
        results.append(long_axis_children(*parents))
    assert all(torch.equal(rows, other[name]) for other in results[1:] for name, rows in results[0].items())
