"""Culling changes no bit: exact lists of instances against lists with all splats in all tiles."""

import pytest
from rasterizer_tools import BOTH_AND_GPU, assert_culling_is_exact, borderline_splats, ops, scene_arguments

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
