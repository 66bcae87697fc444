"""Tile culling changes no bit: exact instance lists against lists with every splat in every tile."""

import pytest
import torch
from rasterizer_tools import assert_culling_is_exact, borderline_splats, ops, scene_arguments

from benchmarks.splat_scenes import KINDS, settings

BOTH = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
SIZE = (75, 53)


@BOTH
@pytest.mark.parametrize("kind", KINDS)
def test_no_pixel_differs(kind, dtype):
    scene = KINDS[kind](400, *SIZE)
    parameters = {name: t.to(dtype) for name, t in scene.parameters.items()}
    projected = ops.project(*scene_arguments(parameters, settings(*SIZE, dtype)))
    assert_culling_is_exact(projected[0], *projected[1:4], *SIZE)


@BOTH
def test_no_pixel_differs_where_opacities_are_tuned_to_the_cut(dtype):
    """Each splat reaches 1/255 at one pixel of one tile's rim within some units in the last place, over or under."""
    *projected, left_out = borderline_splats(600, *SIZE, dtype)
    instances, everywhere = assert_culling_is_exact(*projected, *SIZE, left_out)
    assert instances < 0.6 * everywhere


def test_lists_hold_no_tile_in_vain():
    """Exact: a tile whose pixel centres are all under 1/255 is listed only where the maximum is between them."""
    scene = KINDS["ordinary"](400, *SIZE)
    parameters = {name: t.double() for name, t in scene.parameters.items()}
    splats, depths, rects, counts, _ = ops.project(*scene_arguments(parameters, settings(*SIZE)))
    instances, _, ranges, _ = ops.bin(splats, depths, rects, counts, 53, 75, False)
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
