"""Culling changes no bit: exact lists of instances against lists with all splats in all tiles, pixels against sums."""

import math

import pytest
import torch
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, assert_culling_is_exact, borderline_splats, ops, scene_arguments

from groundwork.host.machine import instruction_set
from tests.workloads.splat_scenes import KINDS, settings

SIZE = (75, 53)


@BOTH_AND_GPU
@pytest.mark.parametrize("projection", ["ewa", "ray"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_pixel_differs(kind, projection, device, dtype):
    scene = KINDS[kind](400, *SIZE).to(device)
    parameters = {name: t.to(dtype) for name, t in scene.parameters.items()}
    parameters["means"][::5, 2] -= 2  # some lie around the camera, or behind it
    projected = ops.project(*scene_arguments(parameters, settings(*SIZE, dtype, projection=projection)))
    instances, everywhere = assert_culling_is_exact(projected[0], *projected[1:4], *SIZE)
    assert kind == "huge and tiny" or instances < 0.6 * everywhere


@BOTH_AND_GPU
def test_no_pixel_differs_where_opacities_are_tuned_to_the_cut(device, dtype):
    """Each splat reaches 1/255 at one pixel on a tile's rim, within some units in the last place above or below."""
    *projected, left_out = borderline_splats(600, *SIZE, dtype, device)
    instances, everywhere = assert_culling_is_exact(*projected, *SIZE, left_out)
    assert instances < 0.6 * everywhere


@CPU_AND_GPU
def test_the_pixels_reached_are_those_whose_exponent_comes_to_the_cut(device):
    """Culling within a tile (rows of lanes, a GPU's sub-tiles) changes no bit either.

    Each tuned splat is rendered alone, and its exponent is computed by the kernels' own operations, one by one.
    """
    if device == "cpu" and instruction_set() == "baseline":
        pytest.skip("fused operations are emulated, and this instruction set has none")
    width, height = SIZE
    *projected, _ = borderline_splats(600, *SIZE, torch.float32, device)
    splats = projected[0][projected[3] > 0]
    tiles = -(-width // 16) * -(-height // 16)
    x, y = torch.arange(width, device=device), torch.arange(height, device=device)[:, None]
    left, top = x // 16 * 16, y // 16 * 16
    x, y = (x - left).float(), (y - top).float()
    near = 0
    for i, s in enumerate(splats):
        instances = torch.full((tiles,), i, dtype=torch.int32, device=device)
        ranges, background = torch.arange(tiles + 1, device=device), torch.zeros(3, device=device)
        rest = ops.blend(splats, instances, ranges, background, height, width, False, False)[1][0]
        mean_x, mean_y, l11, l12, l22, log2_opacity = s[:6]
        v = l22 * (y - (mean_y - top))
        u = l12.double() * (top.double() + 7.5 - mean_y) + l11.double() * (left.double() + 7.5 - mean_x)
        u = _fused(l11, x - 7.5, _fused(l12, y - 7.5, u.float()))
        exponent = _fused(-u, u, _fused(-v, v, log2_opacity))
        least = torch.tensor(-math.log2(255), dtype=torch.float32, device=device)
        assert torch.equal(rest < 1, exponent >= least)
        near += int((exponent - least).abs().min() < 1e-5)
    assert near > 0.5 * len(splats)


def _fused(a: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
    """Return a b + c in float32, rounded once, since the product is exact in float64."""
    return (a.double() * b.double() + c.double()).float()


def test_lists_hold_no_tile_in_vain():
    """The lists are exact: a tile with all pixel centres below 1/255 is listed only if its maximum is between them."""
    scene = KINDS["ordinary"](400, *SIZE)
    parameters = {name: t.double() for name, t in scene.parameters.items()}
    splats, depths, rects, counts, _ = ops.project(*scene_arguments(parameters, settings(*SIZE)))
    instances, ranges, _, _ = ops.bin(splats, depths, rects, counts, 53, 75, False)
    x, y = torch.arange(75.0), torch.arange(53.0)
    vain = 0
    for tile in range(len(ranges) - 1):
        xs, ys = x[(x // 16) == tile % 5], y[(y // 16) == tile // 5]
        s = splats[instances[ranges[tile] : ranges[tile + 1]].long()]
        dx, dy = xs[None, None, :] - s[:, 0, None, None], ys[None, :, None] - s[:, 1, None, None]
        u, v = s[:, 2, None, None] * dx + s[:, 3, None, None] * dy, s[:, 4, None, None] * dy
        t = s[:, 5, None, None] - u * u - v * v
        vain += (t.amax((1, 2)) < torch.log2(torch.tensor(1 / 255, dtype=torch.float64))).sum().item()
    assert vain < 0.02 * len(instances)  # measured: 0.8 %
