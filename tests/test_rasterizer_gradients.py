"""Gradients against central differences in float64, far from cut-offs: 1/255 < alpha < 0.99 on all pixels."""

import math

import pytest
import torch
from rasterizer_tools import BOTH_AND_GPU, activated, few, move_camera, ops, pick, render, scene_arguments

from tests.workloads.splat_scenes import settings
from utils.sh_utils import RGB2SH

# With steps of 1e-6, truncation and rounding leave errors of some 1e-9; a wrong term is far above 1e-6.
CHECK = {"eps": 1e-6, "atol": 1e-7, "rtol": 1e-6}


def _check(parameters, camera, raw=True, **check):
    with torch.no_grad():
        out = render(parameters, camera, raw=raw)
        splats = ops.project(*scene_arguments(parameters, camera, raw))[0]
    # The scene is as described above: every splat is on every pixel, and none is opaque.
    ys, xs = torch.meshgrid(torch.arange(7.0), torch.arange(18.0), indexing="ij")
    for s in splats:
        u = s[2] * (xs - s[0]) + s[3] * (ys - s[1])
        v = s[4] * (ys - s[1])
        alpha = torch.exp2(s[5] - u * u - v * v)
        assert alpha.min() > 1.05 / 255 and alpha.max() < 0.98
    assert out.transmittance.min() > 1e-3

    names = list(parameters)
    weights = torch.randn(3, 5 * 7 * 18, dtype=torch.float64, generator=torch.Generator().manual_seed(4)) / 25

    def sums(*values):  # of all pixels of all planes, in three random ways
        out = render(dict(zip(names, values, strict=True)), camera, raw=raw)
        return weights @ torch.cat([out.color, out.inverse_depth, out.transmittance]).flatten()

    inputs = [parameters[name].detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(sums, inputs, **(CHECK | check))


@pytest.mark.parametrize(("side", "axis", "antialiasing"), [(-1, 0, True), (1, 0, False), (-1, 1, False), (1, 1, True)])
def test_the_clamped_ray_has_its_exact_derivative(side, axis, antialiasing):
    """Beyond 1.3 half images J is constant: x gets no gradient through it, z only through its factor 1/z (DGR#75)."""
    parameters, size = few(2)
    camera = settings(**size, principal=(0.1, -0.1), antialiasing=antialiasing)
    tan = (camera.tanfovx, camera.tanfovy)[axis]
    means = parameters["means"]
    means[0, axis] = side * 1.6 * tan * means[0, 2]
    if axis == 1:  # so far outside along the short side, alpha needs a longer splat
        means[0, 0] = 0.0
    parameters["scales"][0] += 0.3
    parameters["opacities"][0] = 1.5
    _check(parameters, camera)


def test_each_plane_gives_its_gradient_alone():
    """A backward from one result must not depend on whether the others are used or requested."""
    parameters, size = few()
    camera = settings(**size)
    names = list(parameters)
    inputs = {name: t.clone().requires_grad_() for name, t in parameters.items()}

    def grad(plane, **wanted):
        out = getattr(render(inputs, camera, **wanted), plane)
        weights = torch.linspace(-1, 1, out.numel(), dtype=torch.float64).reshape(out.shape)
        grads = torch.autograd.grad((weights * out).sum(), list(inputs.values()), allow_unused=True)
        return dict(zip(names, grads, strict=True))

    alone = grad("color", want_inverse_depth=False, want_transmittance=False)
    for name, g in grad("color").items():
        assert torch.equal(g, alone[name])
    assert not grad("inverse_depth")["sh_dc"].any()
    assert not grad("transmittance")["sh_rest"].any()
    for plane in ("inverse_depth", "transmittance"):
        assert grad(plane)["opacities"].all()


@BOTH_AND_GPU
@pytest.mark.parametrize("degree", [0, 3])
def test_a_black_point_of_a_cloud_can_become_brighter(degree, device, dtype):
    """Its colour is 0 up to rounding of either sign; if the clamp stopped the gradient, it would stay black."""
    parameters, size = few(1, dtype=dtype)
    parameters["sh_dc"] = RGB2SH(torch.zeros(1, 1, 3, dtype=dtype))
    parameters["sh_rest"] = torch.zeros_like(parameters["sh_rest"])
    inputs = {name: t.to(device).requires_grad_() for name, t in parameters.items()}
    render(inputs, move_camera(settings(**size, sh_degree=degree), device)).color.sum().backward()
    assert (inputs["sh_dc"].grad > 0).all()


@pytest.mark.parametrize("side", [0.9, 1.1])
def test_the_antialiasing_factor_is_floored(side):
    """Below det0/det = 2.5e-5 the factor is 0.005 for every scale, so the scale gets no gradient through it."""
    parameters, size = few(1, 17, 7)  # odd: the mean is at the middle pixel's centre
    parameters["means"][:, :2] = 0.0
    parameters["opacities"][:] = 4.0
    # (s^2 / (s^2 + 0.3))^2 = 2.5e-5 for a round splat of s px.
    s = (0.3 * 0.005 / (1 - 0.005)) ** 0.5 * side
    focal = 17 / (2 * settings(**size).tanfovx)
    parameters["scales"][:] = math.log(s * 2 / focal)
    inputs = {name: t.clone().requires_grad_() for name, t in parameters.items()}
    factor = max(0.005, s * s / (s * s + 0.3))
    opacity = torch.sigmoid(parameters["opacities"]).item()
    alpha = 1 - render(inputs, settings(**size, antialiasing=True)).transmittance[0, 3, 8]
    assert alpha.item() == pytest.approx(opacity * factor, rel=1e-12)
    alpha.backward()
    assert (inputs["scales"].grad.sum() == 0) == (side < 1)  # test_rasterizer_oracle.py: its value


@BOTH_AND_GPU
@pytest.mark.parametrize("opacity", [0.0, -1e-9, -0.5, -1e30])
def test_an_opacity_of_0_or_less_is_not_drawn(opacity, device, dtype):
    """Interpolated and masked opacities fall below 0; a logarithm of such a value must not count as opaque."""
    parameters, size = few(dtype=dtype)
    splats = {name: values.to(device) for name, values in activated(parameters).items()}
    camera = move_camera(settings(**size), device)
    mask = torch.tensor([1.0, 0.0, 1.0], device=device, dtype=dtype)[:, None]
    masked = splats | {"opacities": torch.where(mask > 0, splats["opacities"], opacity).requires_grad_()}
    out = render(masked, camera, raw=False)
    without = render(pick(splats, [0, 2]), camera, raw=False)
    assert torch.equal(out.color, without.color) and torch.equal(out.transmittance, without.transmittance)
    out.color.sum().backward()
    gradient = masked["opacities"].grad
    assert gradient[1] == 0 and gradient[0] != 0 and gradient.isfinite().all()
