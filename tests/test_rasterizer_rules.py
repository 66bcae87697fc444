"""The reference's rules at their thresholds (CONTRACT.md 6.2 to 6.5), by hand sums."""

import math

import pytest
import torch
from diff_gaussian_rasterization.ops import mark_visible
from rasterizer_tools import DTYPES_AND_GPU, one_splat, render, together

from tests.workloads.splat_scenes import settings

BOTH = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
MIDDLE = (..., 8, 8)  # of 17 x 17: the optical axis goes exactly through this pixel's centre


def camera(dtype=torch.float64, **changes):
    return settings(17, 17, dtype, **changes)


def leaf(splats):
    return {name: t.clone().requires_grad_() for name, t in splats.items()}


def nextafter(value: float, towards: float, dtype: torch.dtype) -> float:
    return torch.nextafter(torch.tensor(value, dtype=dtype), torch.tensor(towards, dtype=dtype)).item()


@DTYPES_AND_GPU
def test_the_near_plane_is_at_0_2_and_excluded(dtype):
    near = torch.tensor(0.2, dtype=dtype).item()
    for z, visible in [(near, False), (nextafter(near, 1, dtype), True), (-1.0, False), (0.0, False)]:
        out = render(one_splat(z=z, dtype=dtype), camera(dtype), raw=False)
        assert bool(out.radii[0] > 0) == visible
        assert bool(out.transmittance.min() < 1) == visible
        assert bool(mark_visible(torch.tensor([[0.0, 0.0, z]], dtype=dtype), torch.eye(4, dtype=dtype))) == visible


@BOTH
def test_alpha_of_1_255_is_blended_and_less_is_not(dtype):
    least = torch.tensor(1 / 255, dtype=dtype).item()
    # Ten units in the last place, since those of the logarithm are coarser than the opacity's.
    less = least * (1 - 10 * torch.finfo(dtype).eps)
    for opacity, blended in [(least, True), (less, False)]:
        out = render(one_splat(opacity=opacity, dtype=dtype), camera(dtype), raw=False)
        assert bool(out.transmittance[MIDDLE] < 1) == blended
        assert out.radii[0] > 0  # the radius decides visibility, even if no pixel is reached
        assert (out.transmittance == 1).sum() == 17 * 17 - blended


@DTYPES_AND_GPU
def test_no_pixel_is_blended_under_1_255(dtype):
    """The rule also holds far from the mean: there is no cut at 3 sigma, where alpha is 0.011."""
    splat = one_splat(opacity=0.9, scale=0.2, dtype=dtype)
    out = render(splat, camera(dtype), raw=False)
    variance = (0.2 * 17 / (2 * math.tan(math.radians(30)))) ** 2 + 0.3
    ys, xs = torch.meshgrid(torch.arange(17.0) - 8, torch.arange(17.0) - 8, indexing="ij")
    alpha = 0.9 * torch.exp(-(xs**2 + ys**2).double() / (2 * variance))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    assert (alpha == 0).sum() > 0
    assert (alpha[(alpha > 0)] < 0.9 * math.exp(-4.5)).any()
    # Float: rounding of the exponent.
    torch.testing.assert_close(
        1 - out.transmittance[0].double(), alpha, rtol=0, atol={8: 1e-14, 4: 1e-6}[dtype.itemsize]
    )


@DTYPES_AND_GPU
def test_alpha_is_capped_at_0_99_and_the_gradient_passes(dtype):
    splat = leaf(one_splat(opacity=0.995, dtype=dtype))
    background = torch.tensor([0.25, 0.0, 0.5], dtype=dtype)
    out = render(splat, camera(dtype, bg=background), raw=False)
    color, eps = splat["colors"][0], 8 * torch.finfo(dtype).eps
    torch.testing.assert_close(out.color[MIDDLE], 0.99 * color + 0.01 * background, rtol=eps, atol=eps)
    torch.testing.assert_close(out.transmittance[MIDDLE], torch.tensor([0.01], dtype=dtype), rtol=100 * eps, atol=0)
    out.color[0, 8, 8].backward()
    # d colour / d opacity = colour - background, as if alpha were the uncapped 0.995.
    assert splat["opacities"].grad.item() == pytest.approx(1.0 - 0.25, rel=1e-5 if dtype == torch.float32 else 1e-12)
    assert splat["colors"].grad[0, 0].item() == pytest.approx(0.99, rel=1e-6)


@DTYPES_AND_GPU
def test_the_splat_that_would_leave_less_than_1e_4_ends_the_pixel_unblended(dtype):
    opacities = [0.95, 0.95, 0.95, 0.95, 0.01]  # the last would not end the pixel, but it has ended before
    splats = [one_splat(z=1 + i, opacity=o, scale=0.05 * (1 + i), dtype=dtype) for i, o in enumerate(opacities)]
    splats = leaf(together(*splats))
    splats["colors"] = torch.eye(5, 3, dtype=dtype, requires_grad=True)
    out = render(splats, camera(dtype, bg=torch.zeros(3, dtype=dtype)), raw=False)
    # 1 - 0.95 turns a unit in the last place into 20. A GPU's exponential is exact to two, and there are three factors.
    bound = 2 * 3 * 20 * torch.finfo(dtype).eps
    assert out.transmittance[MIDDLE].item() == pytest.approx(0.05**3, rel=bound)
    wanted = torch.tensor([0.95, 0.95 * 0.05, 0.95 * 0.05**2], dtype=dtype)
    torch.testing.assert_close(out.color[MIDDLE], wanted, rtol=bound, atol=0)
    (out.color[:, 8, 8].sum() + out.transmittance[0, 8, 8] + out.inverse_depth[0, 8, 8]).backward()
    for t in splats.values():
        assert not t.grad[3:].any()
    assert splats["colors"].grad[:3].all() and splats["opacities"].grad[:3].all()


@DTYPES_AND_GPU
@pytest.mark.parametrize(("third", "blended"), [(0.9599, True), (0.9601, False)])
def test_the_transmittance_limit_is_1e_4(third, blended, dtype):
    opacities = [0.95, 0.95, third]  # 0.0025 (1 - third)
    splats = [one_splat(z=1 + i, opacity=o, dtype=dtype) for i, o in enumerate(opacities)]
    left = render(together(*splats), camera(dtype), raw=False).transmittance[MIDDLE].item()
    assert left == pytest.approx(0.0025 * (1 - third) if blended else 0.0025, rel=1e-3)


def expected_radius(a: float, b: float, c: float) -> int:
    root = math.sqrt(max(0.1, ((a - c) / 2) ** 2 + b * b))
    return math.ceil(3 * math.sqrt((a + c) / 2 + root))


@DTYPES_AND_GPU
def test_radius_is_3_sigma_of_the_longer_axis(dtype):
    focal = 17 / (2 * math.tan(math.radians(30)))
    for sx, sy, angle in [(1e-6, 1e-6, 0.0), (0.05, 0.05, 0.3), (0.3, 0.02, 0.0), (0.3, 0.02, 0.7), (0.1, 0.5, -1.1)]:
        splat = one_splat(dtype=dtype)
        splat["scales"] = torch.tensor([[sx, sy, 1e-6]], dtype=dtype)
        splat["rotations"] = torch.tensor([[math.cos(angle / 2), 0, 0, math.sin(angle / 2)]], dtype=dtype)
        x, y = (sx * focal) ** 2, (sy * focal) ** 2
        c, s = math.cos(angle), math.sin(angle)
        wanted = expected_radius(x * c * c + y * s * s + 0.3, (x - y) * c * s, x * s * s + y * c * c + 0.3)
        assert render(splat, camera(dtype), raw=False).radii.tolist() == [wanted]
    # Without the least value of 0.1 under the root, a point's radius would be 2.
    assert expected_radius(0.3, 0, 0.3) == 3


def test_radius_does_not_depend_on_opacity_and_ends_at_the_image():
    splat = one_splat(opacity=1e-9)
    out = render(splat, camera(), raw=False)
    assert out.radii[0] > 0 and (out.transmittance == 1).all()
    focal = 17 / (2 * math.tan(math.radians(30)))
    radius = out.radii.item()
    seen = set()
    for pixel in torch.arange(-40.25, 60, 1.0).tolist():
        # The splat gets all tiles that the square of that radius touches: two across 17 pixels.
        low = min(2, max(0, math.trunc((pixel - radius) / 16)))
        high = min(2, max(0, math.trunc((pixel + radius + 15) / 16)))
        got = render(one_splat(x=(pixel - 8) / focal, opacity=1e-9), camera(), raw=False).radii.item()
        assert got == (radius if high > low else 0)
        seen.add(got > 0)
    assert seen == {True, False}


def test_equal_depths_keep_the_order_of_their_index():
    red = one_splat(opacity=0.8, color=(1, 0, 0))
    green = one_splat(opacity=0.8, color=(0, 1, 0))
    black = camera(bg=torch.zeros(3, dtype=torch.float64))
    for first, second, wanted in [(red, green, [0.8, 0.16, 0]), (green, red, [0.16, 0.8, 0])]:
        got = render(together(first, second), black, raw=False).color[MIDDLE]
        torch.testing.assert_close(got, torch.tensor(wanted, dtype=torch.float64), rtol=1e-12, atol=0)
