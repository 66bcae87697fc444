"""The operators: the single steps against the whole, their names and sizes, and what is too large for them."""

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians, fakes, schema
from rasterizer_tools import BOTH_AND_GPU, few, leaves, ops, render, scene_arguments, together

from benchmarks.workloads.splat_scenes import on_device, settings


def _few(device: str, dtype: torch.dtype = torch.float32) -> tuple[dict, GaussianRasterizationSettings]:
    """A few splats and their camera."""
    raw, size = few(dtype=dtype)
    return {name: t.to(device) for name, t in raw.items()}, on_device(settings(**size), device)


@BOTH_AND_GPU
def test_the_steps_one_by_one_are_the_whole(device, dtype):
    """rasterize is project, bin and blend; rasterize_vjp is blend_vjp and project_vjp."""
    raw, camera = _few(device, dtype)
    raw = together(raw, raw)
    arguments = scene_arguments(raw, camera)
    splats, depths, rects, counts, radii = ops.project(*arguments)
    instances, ranges, *slots = ops.bin(splats, depths, rects, counts, 7, 18, True)
    color, transmittance, inverse_depth, last, _ = ops.blend(splats, instances, ranges, camera.bg, 7, 18, True, True)
    inputs = leaves(raw)
    out = render(inputs, camera)
    assert torch.equal(out.color, color) and torch.equal(out.transmittance, transmittance)
    assert torch.equal(out.inverse_depth, inverse_depth) and torch.equal(out.radii, radii)
    weights = torch.linspace(-1, 1, color.numel()).reshape(color.shape).to(color)
    (weights * out.color).sum().backward()
    state = (splats, instances, ranges, *slots, camera.bg, last, transmittance)
    moments = ops.blend_vjp(*state, weights, None, None)
    wanted = [True, False, True, True, True, False, False, True, True]
    gradients = ops.project_vjp(*arguments, counts, moments, wanted)
    for name, g in zip(
        ("means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"),
        [*gradients[:1], *gradients[2:5], *gradients[7:]],
        strict=True,
    ):
        if device == "cpu":
            assert torch.equal(inputs[name].grad, g), name
        else:  # two kernels of one template, which the compiler may fuse differently
            torch.testing.assert_close(inputs[name].grad, g, rtol=1e-5, atol=1e-6 * g.abs().max().item())
    assert gradients[1].numel() == gradients[5].numel() == 0


def test_the_gaussians_are_the_operators_first_inputs():
    assert schema.SCENE[: len(Gaussians._fields)] == Gaussians._fields
    assert schema.INPUTS[: 1 + len(schema.SCENE)] == ("means2d", *schema.SCENE)
    assert set(schema.GRADIENTS) == {"means2d", *Gaussians._fields}


def test_the_fake_kernels_have_the_sizes_of_the_real_ones():
    raw, camera = _few("cpu")
    arguments = scene_arguments(raw, camera)
    splats, depths, rects, counts, _ = ops.project(*arguments)
    assert splats.shape[1] == fakes.SPLAT_VALUES
    for size, tiles in ((fakes.TILE, 1), (fakes.TILE + 1, 4)):
        assert len(ops.bin(splats, depths, rects, 0 * counts, size, size, False)[1]) == tiles + 1
    lists = ops.bin(splats, depths, rects, counts, 7, 18, True)
    color, transmittance, _, last, _ = ops.blend(splats, *lists[:2], camera.bg, 7, 18, False, True)
    moments = ops.blend_vjp(splats, *lists, camera.bg, last, transmittance, color, None, None)
    assert moments.shape[1] == fakes.MOMENT_VALUES
    rects, limits = torch.zeros(fakes.RECORD_BLOCK + 1, 4, dtype=torch.int32), torch.zeros(2, 3, dtype=torch.int32)
    for splats, blocks in ((fakes.RECORD_BLOCK, 1), (fakes.RECORD_BLOCK + 1, 2)):
        assert ops.count_records(rects[:splats], rects[:splats, 0], limits).shape == (4, blocks)


@pytest.mark.parametrize(
    ("counts", "named"),
    [
        ((2**31 - 1,) * 3, r"\d \(2147483647\), \d \(2147483647\), \d \(2147483647\)"),
        ((7, 2**31 - 1, 2**30), r"1 \(2147483647\), 2 \(1073741824\), 0 \(7\)"),
    ],
)
def test_more_instances_than_an_index_holds_are_an_error(counts, named):
    """It is refused before allocating: 6.4 billion instances would be 50 GB. The message names the largest splats."""
    raw, size = few(dtype=torch.float32)
    splats, depths, rects, _, _ = ops.project(*scene_arguments(raw, settings(**size)))
    faked = torch.tensor(counts, dtype=torch.int32)
    with pytest.raises(
        RuntimeError,
        match=f"3 Gaussians cover {sum(counts)} tile instances, more than 2.31 - 1; most are those of Gaussian {named}",
    ):
        ops.bin(splats, depths, rects, faked, 7, 18, True)


def test_an_image_of_more_tiles_than_an_index_holds_is_an_error():
    """It is refused at once, since counting the tiles of a giant splat would take hours."""
    raw, size = few(dtype=torch.float32)
    camera = settings(**size)._replace(image_width=2**23, image_height=2**23)
    with pytest.raises(RuntimeError, match=r"image size 8388608x8388608 has more than 2\^31 - 1 tiles"):
        render(raw, camera)
