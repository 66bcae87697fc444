"""Poison in one Gaussian: nothing crashes, no other Gaussian changes, and values not finite get zero gradients.

`python -m tests.fuzz` draws poison at random, in several places at once.
"""

import math

import pytest
import torch
from diff_gaussian_rasterization.channels import rasterize_channels
from diff_gaussian_rasterization.lens import Lens
from rasterizer_tools import CPU_AND_GPU, PLANES, activated, gradients, leaves, pick, render
from torch import Tensor

from tests.workloads.splat_scenes import KINDS, move_camera, ordinary, settings

N, VICTIM, SIZE = 40, 17, (75, 53)
NOT_FINITE = [math.nan, math.inf, -math.inf]
# Values near thresholds, values whose squares or cubes overflow float, and values that vanish in it.
EXTREME = [3.4e38, -3.4e38, 1e20, -1e20, 1e10, -1e10, 1e-20, 1e-38, -1e-45, 0.0, 1 / 255, 0.2, 0.99, 1.3, 16.0, 1e4]
EXTREME += [1e7, 30.0, -50.0, 50.0, 88.0, -104.0]


@pytest.fixture(scope="module")
def camera():
    return settings(*SIZE, torch.float32, antialiasing=True)


def scene(raw: bool) -> dict[str, Tensor]:
    parameters = {name: t.float() for name, t in ordinary(N, *SIZE).parameters.items()}
    parameters["means"][VICTIM] = torch.tensor([0.1, -0.1, 3.0])  # in the middle of things
    if raw:
        return parameters
    out = activated(parameters)
    del out["sh_dc"], out["sh_rest"], out["scales"], out["rotations"]
    axes = torch.randn(N, 3, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    out["cov3d"] = (axes @ axes.mT)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    out["colors"] = torch.rand(N, 3, generator=torch.Generator().manual_seed(2))
    return out


CASES = [(True, name) for name in ("means", "opacities", "scales", "rotations", "sh_dc", "sh_rest")]
CASES += [(False, name) for name in ("opacities", "cov3d", "colors")]


def poisoned(parameters: dict[str, Tensor], name: str, value: float, whole_row: bool) -> dict[str, Tensor]:
    out = {k: t.clone() for k, t in parameters.items()}
    flat = out[name][VICTIM].view(-1)
    flat[: flat.numel() if whole_row else 1] = value
    return out


@CPU_AND_GPU
@pytest.mark.parametrize(("raw", "name"), CASES)
def test_a_gaussian_that_is_not_finite_is_as_if_it_were_not_there(raw, name, camera, device):
    parameters = scene(raw)
    others = torch.arange(N) != VICTIM
    wanted = gradients(pick(parameters, others), camera, device, raw=raw)
    for value in NOT_FINITE:
        if raw and name == "opacities" and math.isinf(value):
            continue  # a valid logit
        for whole_row in (False, True):
            bad = poisoned(parameters, name, value, whole_row)
            got = gradients(bad, camera, device, raw=raw)
            for key, t in got.items():
                if key in ("color", "inverse_depth", "transmittance"):
                    assert torch.equal(t, wanted[key]), (key, value)
                else:
                    assert torch.equal(t[others], wanted[key]), (key, value)
                    # Colours are read only for splats with tiles, so they do not decide the radius.
                    assert not t[VICTIM].any() or (key == "radii" and name in ("sh_dc", "sh_rest", "colors")), (
                        key,
                        value,
                    )


def planes_of(inputs: dict[str, Tensor], camera, channels: int, means2d: Tensor) -> list[Tensor]:
    """Return what a camera shows: a colour, an inverse depth and a transmittance, or so many channels."""
    if not channels:
        out = render(inputs, camera, means2d, want_absolute_gradient=True)
        return [getattr(out, plane) for plane in PLANES]
    rest = {name: t for name, t in inputs.items() if not name.startswith("sh")}
    rest |= {"features": inputs["sh_rest"].flatten(1)[:, :channels], "raw": True}
    return list(
        rasterize_channels(means2d=means2d, settings=camera._replace(bg=means2d.new_ones(channels)), **rest)[:2]
    )


@CPU_AND_GPU
@pytest.mark.parametrize(
    ("channels", "options"),
    [
        *((channels, {}) for channels in (0, 3, 4, 7, 40)),
        *((channels, {"projection": "ray"}) for channels in (0, 7)),
        (0, {"projection": "ray", "lens": Lens("equidistant", (60.0, 60.0), (37.0, 26.0))}),
    ],
)
def test_what_is_not_finite_at_a_pixel_is_of_those_that_reach_it(channels, options, camera, device):
    """Gradients of pixels, and channels of a Gaussian: elsewhere all has the bits of what is finite."""
    camera = move_camera(camera._replace(**options), device)

    def results(value: float, pixels: Tensor, gradient: float, others: float) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Planes and gradients. value: the victim's. gradient, others: of the pixels, and a factor of others'."""
        inputs = leaves({name: t.to(device) for name, t in scene(True).items()})
        if channels:
            inputs["sh_rest"].data[VICTIM] = value
        means2d = torch.zeros_like(inputs["means"], requires_grad=True)
        planes = planes_of(inputs, camera, channels, means2d)
        draw = torch.Generator().manual_seed(3)
        weights = [others * torch.randn(t.shape, generator=draw).to(t) for t in planes]
        torch.autograd.backward(planes, [torch.where(pixels, gradient, w) for w in weights])
        return planes, {name: t.grad for name, t in [*inputs.items(), ("means2d", means2d)] if t.grad is not None}

    no_pixel = torch.zeros(SIZE[::-1], dtype=torch.bool, device=device)
    pixel = no_pixel.clone()
    pixel[26, 37] = True
    reach = results(0.5, pixel, 1.0, 0.0)[1]["opacities"].flatten() != 0
    wanted = results(0.5, pixel, 0.0, 1.0)[1]
    assert 0 < reach.sum() < N
    for value in (math.nan, math.inf):
        for name, gradient in results(0.5, pixel, value, 1.0)[1].items():
            assert torch.equal(gradient[~reach], wanted[name][~reach]), name
            assert not gradient[reach].isfinite().all(), name
    if not channels:
        return
    planes, wanted = results(0.0, no_pixel, 0.0, 1.0)
    seen = (planes[0] != results(1e3, no_pixel, 0.0, 1.0)[0][0]).any(0)
    shown, found = results(math.nan, no_pixel, 0.0, 1.0)
    assert seen.any() and not seen.all() and torch.equal(shown[0].isnan().all(0), seen)
    assert torch.equal(shown[0][:, ~seen], planes[0][:, ~seen]) and torch.equal(shown[1], planes[1])
    apart = results(0.0, seen, math.nan, 1.0)[1]["opacities"].flatten().isfinite()
    assert apart.any() and all(torch.equal(found[name][apart], wanted[name][apart]) for name in found)


@CPU_AND_GPU
@pytest.mark.parametrize(("raw", "name"), CASES)
def test_extreme_finite_values_leave_everything_finite(raw, name, camera, device):
    parameters = scene(raw)
    for value in EXTREME:
        for whole_row in (False, True):
            for key, t in gradients(poisoned(parameters, name, value, whole_row), camera, device, raw=raw).items():
                assert t.isfinite().all(), (key, value)


@pytest.mark.parametrize("kind", KINDS)
def test_weights_sum_to_one_and_the_order_of_gaussians_does_not_matter(kind):
    parameters = {name: t.float() for name, t in KINDS[kind](N, *SIZE).parameters.items()}
    parameters["means"][::7, 2] = torch.tensor([1e-20, 3.4e38, -1e20, 0.2, math.nan, math.inf])[: -(-N // 7)]
    black = settings(*SIZE, torch.float32, bg=torch.zeros(3))
    order = torch.randperm(N, generator=torch.Generator().manual_seed(0))
    got, permuted = (gradients(p, black) for p in (parameters, pick(parameters, order)))
    for name, t in permuted.items():
        assert torch.equal(t, got[name][order] if len(t) == N else got[name]), name
    white = {name: t for name, t in parameters.items() if not name.startswith("sh")} | {"colors": torch.ones(N, 3)}
    out = render(white, black)
    assert out.color.min() >= 0  # and the sums of rounded products are 1
    torch.testing.assert_close(out.color + out.transmittance, torch.ones(3, *SIZE[::-1]), rtol=0, atol=3e-6)


# Powers of two, whose products are exact; their squares exceed float32's range.
@pytest.mark.parametrize("length", [2.0**-70, 2.0**70])
def test_the_length_of_a_raw_quaternion_does_not_matter(length, camera):
    parameters = scene(True)
    long = parameters | {"rotations": parameters["rotations"] * length}
    got, wanted = gradients(long, camera), gradients(parameters, camera)
    assert torch.equal(got["color"], wanted["color"])
    torch.testing.assert_close(got["d rotations"] * length, wanted["d rotations"], rtol=1e-6, atol=0)


@CPU_AND_GPU
@pytest.mark.parametrize("axes", [(0,), (2,), (0, 1, 2)])
def test_giants_are_drawn_or_culled_alike_in_both_precisions(axes, camera, device):
    """Their squares leave float32's range, where float64 went on drawing."""
    seen = []
    for exponent in (14, 15, 16, 17, 17.5, 18.5, 19, 20, 30, 38):
        giant = scene(True)
        giant["scales"][VICTIM, list(axes)] = math.log(10) * exponent
        got = gradients(giant, camera, device)
        exact = gradients({name: t.double() for name, t in giant.items()}, camera)
        assert (got["color"] - exact["color"]).abs().max() < 1e-5, exponent
        assert (got["radii"][VICTIM] > 0) == (exact["radii"][VICTIM] > 0)
        seen.append(bool(got["radii"][VICTIM]))
    assert seen[0] and not seen[-1] and seen == sorted(seen, reverse=True)


@CPU_AND_GPU
def test_a_degenerate_covariance_is_finite(camera, device):
    for values in ([0.0] * 6, [1, 1, 1, 1, 1, 1], [1e-3, 0, 0, -1e-3, 0, 1e-3], [1e-3, 1, 0, 1e-3, 0, 1e-3]):
        bad = scene(False)
        bad["cov3d"][VICTIM] = torch.tensor(values, dtype=torch.float32)
        assert all(t.isfinite().all() for t in gradients(bad, camera, device, raw=False).values()), values
