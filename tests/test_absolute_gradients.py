"""Absolute gradients of the means on the image: the kernels against the float64 oracle, one pixel at a time."""

import functools

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, reference
from rasterizer_tools import BOTH_AND_GPU, gradients, leaves, loss_of, render
from torch import Tensor

from benchmarks.workloads.splat_scenes import KINDS, settings
from scene.gaussians.statistics import Statistics

SIZE = (21, 18)  # two tiles by two, cut off
# Of the largest length; a few times the largest error measured, which is rounding of the sum over pixels.
BOUNDS = {torch.float64: 1e-14, torch.float32: 2e-6}


def _scene(kind: str) -> dict[str, Tensor]:
    return {name: t.float() for name, t in KINDS[kind](60, *SIZE).parameters.items()}


def _camera(dtype: torch.dtype, antialiasing: bool) -> GaussianRasterizationSettings:
    return settings(*SIZE, dtype, antialiasing=antialiasing)


@functools.cache
def _oracle(kind: str, antialiasing: bool) -> tuple[Tensor, Tensor]:
    """Pixels (H, W) that count, and what every one of them wants of the means: (pixels, N, 2) per NDC unit."""
    inputs = leaves(_scene(kind), torch.float64)
    means2d = torch.zeros_like(inputs["means"]).requires_grad_()
    out = render(inputs, _camera(torch.float64, antialiasing), means2d, function=reference.render)
    keep = ~out.near_cut
    wanted = []
    for pixel in keep.nonzero():
        alone = torch.zeros_like(keep)
        alone[tuple(pixel)] = True
        loss_of(out, alone).backward(retain_graph=True)
        wanted.append(means2d.grad[:, :2].clone())
        means2d.grad = None
    return keep, torch.stack(wanted)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "antialiasing"), [(k, k != "ordinary") for k in KINDS] + [("ordinary", True)])
@BOTH_AND_GPU
def test_lengths_are_those_of_the_oracle(kind, antialiasing, device, dtype):
    keep, of_pixels = _oracle(kind, antialiasing)
    assert keep.double().mean() > 0.95
    wanted = of_pixels.abs().sum(0).norm(dim=1)
    inputs = {name: t.to(dtype) for name, t in _scene(kind).items()}
    loss = functools.partial(loss_of, keep=keep)
    got = gradients(inputs, _camera(dtype, antialiasing), device, loss, want_absolute_gradient=True)["d means2d"]
    error = (got[:, 2].double() - wanted).abs().max() / wanted.max()
    print(f"{kind:15} {antialiasing=} {dtype} largest {error:.1e}")
    assert error <= BOUNDS[dtype]
    assert (wanted > of_pixels.sum(0).norm(dim=1) * (1 + 1e-9)).sum() > 10  # else signs would not matter
    assert not got[wanted == 0].any()


@pytest.mark.parametrize("planes", [("color",), ("inverse_depth", "color"), ("transmittance",)])
def test_without_it_the_third_value_is_zero_and_all_others_are_the_same(planes):
    inputs = {name: t.double() for name, t in _scene("ordinary").items()}

    def loss(out):
        return sum(getattr(out, plane).square().sum() for plane in planes)

    camera = _camera(torch.float64, False)
    plain = gradients(inputs, camera, "cpu", loss)
    absolute = gradients(inputs, camera, "cpu", loss, want_absolute_gradient=True)
    lengths = absolute["d means2d"][:, 2].clone()
    assert not plain["d means2d"][:, 2].any() and (lengths > 0).any()
    assert (lengths >= plain["d means2d"][:, :2].norm(dim=1) * (1 - 1e-12)).all()
    absolute["d means2d"][:, 2] = 0
    for name, value in plain.items():
        torch.testing.assert_close(absolute[name], value, rtol=1e-12, atol=1e-12)


def test_gaussians_that_are_not_seen_have_none():
    inputs = {name: t.double() for name, t in _scene("ordinary").items()}
    inputs["means"][::3, 2] *= -1  # behind the camera
    inputs["sh_dc"][1] = torch.nan
    got = gradients(inputs, _camera(torch.float64, False), want_absolute_gradient=True)["d means2d"]
    assert not got[::3].any() and not got[1].any() and got.isfinite().all()
    none = {name: t[:0] for name, t in inputs.items()}
    assert gradients(none, _camera(torch.float64, False), want_absolute_gradient=True)["d means2d"].shape == (0, 3)


def test_the_statistics_add_up_lengths_as_they_are():
    statistics, lengths = Statistics.zero(4, "cpu"), torch.tensor([1e-30, 0.1, 3.0, 7.0])
    radii = torch.tensor([1, 5, 0, 2], dtype=torch.int32)
    for _ in range(2):
        statistics.observe(lengths, radii)
    assert statistics.xyz_gradient_accum.reshape(-1).tolist() == (2 * lengths * (radii > 0)).tolist()
    assert statistics.denom.reshape(-1).tolist() == [2, 2, 0, 2]
    assert statistics.max_radii2D.tolist() == [1, 5, 0, 2]
