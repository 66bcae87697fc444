"""Absolute gradients of the means on the image: the kernels against the float64 oracle, one pixel at a time."""

import functools

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, reference
from diff_gaussian_rasterization.lens import Lens
from rasterizer_tools import BOTH_AND_GPU, gradients, leaves, loss_of, render
from torch import Tensor

from scene.gaussians.statistics import Statistics
from tests.workloads.splat_scenes import KINDS, settings

SIZE = (21, 18)  # two tiles by two, cut off
# Of the largest length; a few times the largest error measured, which is rounding of the sum over pixels.
BOUNDS = {torch.float64: 1e-14, torch.float32: 2e-6}
CASES = {
    "ordinary": {},
    "huge and tiny, antialiased": {"antialiasing": True},
    "ordinary, rays": {"projection": "ray"},
    "ordinary, rays of a lens": {"projection": "ray", "lens": Lens("equidistant", (9.0, 9.0), (8.5, 8.0))},
}


def _scene(name: str = "ordinary") -> dict[str, Tensor]:
    return {k: t.float() for k, t in KINDS[name.partition(",")[0]](30, *SIZE).parameters.items()}


def _camera(dtype: torch.dtype, **options) -> GaussianRasterizationSettings:
    return settings(*SIZE, dtype, **options)


@functools.cache
def _oracle(name: str) -> tuple[Tensor, Tensor]:
    """Pixels (H, W) that count, and what every one of them wants of the means: (pixels, N, 2) per NDC unit."""
    inputs = leaves(_scene(name), torch.float64)
    means2d = torch.zeros_like(inputs["means"]).requires_grad_()
    out = render(inputs, _camera(torch.float64, **CASES[name]), means2d, function=reference.render)
    keep = ~out.near_cut
    wanted = []
    for pixel in keep.nonzero():
        alone = torch.zeros_like(keep)
        alone[tuple(pixel)] = True
        wanted.append(torch.autograd.grad(loss_of(out, alone), means2d, retain_graph=True)[0][:, :2])
    return keep, torch.stack(wanted)


@BOTH_AND_GPU
@pytest.mark.parametrize("name", CASES)
def test_lengths_are_those_of_the_oracle(name, device, dtype):
    keep, of_pixels = _oracle(name)
    assert keep.double().mean() > 0.95
    wanted = of_pixels.abs().sum(0).norm(dim=1)
    inputs = {k: t.to(dtype) for k, t in _scene(name).items()}
    loss, camera = functools.partial(loss_of, keep=keep), _camera(dtype, **CASES[name])
    got = gradients(inputs, camera, device, loss, want_absolute_gradient=True)["d means2d"]
    error = (got[:, 2].double() - wanted).abs().max() / wanted.max()
    print(f"{name:30} {dtype} largest {error:.1e}")
    assert error <= BOUNDS[dtype]
    assert (wanted > of_pixels.sum(0).norm(dim=1) * (1 + 1e-9)).sum() > 10  # else signs would not matter
    assert not got[wanted == 0].any()


@pytest.mark.parametrize("planes", [("color",), ("inverse_depth", "color"), ("transmittance",)])
def test_without_it_the_third_value_is_zero_and_all_others_are_the_same(planes):
    inputs = {name: t.double() for name, t in _scene().items()}

    def loss(out):
        return sum(getattr(out, plane).square().sum() for plane in planes)

    camera = _camera(torch.float64)
    plain = gradients(inputs, camera, "cpu", loss)
    absolute = gradients(inputs, camera, "cpu", loss, want_absolute_gradient=True)
    lengths = absolute["d means2d"][:, 2].clone()
    assert not plain["d means2d"][:, 2].any() and (lengths > 0).any()
    assert (lengths >= plain["d means2d"][:, :2].norm(dim=1) * (1 - 1e-12)).all()
    absolute["d means2d"][:, 2] = 0
    for name, value in plain.items():
        torch.testing.assert_close(absolute[name], value, rtol=1e-12, atol=1e-12)


def test_gaussians_that_are_not_seen_have_none():
    inputs = {name: t.double() for name, t in _scene().items()}
    inputs["means"][::3, 2] *= -1  # behind the camera
    inputs["sh_dc"][1] = torch.nan
    got = gradients(inputs, _camera(torch.float64), want_absolute_gradient=True)["d means2d"]
    assert not got[::3].any() and not got[1].any() and got.isfinite().all()
    none = {name: t[:0] for name, t in inputs.items()}
    assert gradients(none, _camera(torch.float64), want_absolute_gradient=True)["d means2d"].shape == (0, 3)


def test_the_statistics_add_up_lengths_as_they_are():
    statistics, lengths = Statistics.zero(4, "cpu"), torch.tensor([1e-30, 0.1, 3.0, 7.0])
    radii = torch.tensor([1, 5, 0, 2], dtype=torch.int32)
    for _ in range(2):
        statistics.observe(lengths, radii)
    assert statistics.xyz_gradient_accum.reshape(-1).tolist() == (2 * lengths * (radii > 0)).tolist()
    assert statistics.denom.reshape(-1).tolist() == [2, 2, 0, 2]
    assert statistics.max_radii2D.tolist() == [1, 5, 0, 2]
