"""The operators: their registration under torch's own checks, and the single steps against the whole."""

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians, fakes, optim, schema
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, few, leaves, ops, render, scene_arguments, together
from torch import library

from benchmarks.workloads.splat_scenes import on_device, settings

ALL = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
UNCOMPARED = ALL[:3]


def _few(device: str, dtype: torch.dtype = torch.float32) -> tuple[dict, GaussianRasterizationSettings]:
    """A few splats and their camera."""
    raw, size = few(dtype=dtype)
    return {name: t.to(device) for name, t in raw.items()}, on_device(settings(**size), device)


def _check(op, *arguments, **keywords):
    library.opcheck(op.default, arguments, keywords)


def _tests(device: str, train: bool) -> tuple[str, ...]:
    """Those of a forward. On a GPU nobody writes the layers of lists that are not cut, so no two calls agree there."""
    return UNCOMPARED if device == "cuda" and train else ALL


@CPU_AND_GPU
@pytest.mark.parametrize("train", [False, True])
@pytest.mark.parametrize("inverse_depth", [False, True])
def test_opcheck_rasterize(inverse_depth, train, device):
    raw, camera = _few(device)
    inputs = leaves(raw) if train else raw
    means2d = torch.zeros(3, 3, requires_grad=train, device=device)
    arguments = means2d, *scene_arguments(inputs, camera), camera.bg.float(), inverse_depth, train
    library.opcheck(ops.rasterize.default, arguments, test_utils=_tests(device, train))


@CPU_AND_GPU
def test_opcheck_every_other_op(device):
    raw, camera = _few(device)
    height, width, background = camera.image_height, camera.image_width, camera.bg.float()
    arguments = scene_arguments(raw, camera)
    _check(ops.project, *arguments)
    splats, depths, rects, counts, _ = ops.project(*arguments)
    for train in (False, True):
        _check(ops.bin, splats, depths, rects, counts, height, width, train)
    instances, ranges, *slots = ops.bin(splats, depths, rects, counts, height, width, True)
    for inverse_depth, train in [(False, False), (True, True)]:
        given = splats, instances, ranges, background, height, width, inverse_depth, train
        library.opcheck(ops.blend.default, given, test_utils=_tests(device, train))
    image, transmittance, plane, last, _ = ops.blend(splats, instances, ranges, background, height, width, True, True)
    _check(ops.decisive, splats, instances, ranges, last)
    state = (splats, instances, ranges, *slots, background, last, transmittance)
    gradients = (torch.ones_like(image), torch.ones_like(transmittance), torch.ones_like(plane))
    _check(ops.blend_vjp, *state, *gradients)
    moments = ops.blend_vjp(*state, *gradients)
    wanted = [True, True, True, True, True, False, False, True, True]
    _check(ops.project_vjp, *arguments, counts, moments, wanted)
    _check(ops.rasterize_vjp, *arguments, *state, *gradients, counts, image.new_empty(0), wanted)
    _check(ops.mark_visible, raw["means"], camera.viewmatrix.float())
    lists = [[torch.rand(3, 3, device=device), torch.rand(2, 5, device=device)] for _ in range(4)]
    counters = [torch.tensor(1.0), torch.tensor(7.0)]
    guard = torch.rand((), device=device), torch.zeros(1, dtype=torch.int64, device=device), 3
    for more in ((), guard):
        _check(ops.adam_, *lists, counters, [0.1, 0.2], 0.9, 0.99, 1e-8, [2, -1], *more)
    moment, seen = torch.rand(3, 3, device=device), torch.tensor([True, False, True], device=device)
    for more in ((), (-1, *guard)):
        _check(ops.sparse_adam_, moment + 1, moment + 2, moment, moment.clone(), seen, 0.1, 0.9, 0.99, 1e-8, *more)
    radii = torch.tensor([0, 3, 5], dtype=torch.int32, device=device)
    statistics = [torch.rand(shape, device=device) for shape in ((3,), (3, 1), (3, 1))]
    _check(ops.observe_, *statistics, radii, torch.rand(3, 3, device=device))


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


def test_statistics_that_do_not_fit_are_named():
    radii, gradient = torch.ones(4, dtype=torch.int32), torch.ones(4, 3)
    three = [torch.zeros(4), torch.zeros(4, 1), torch.zeros(4, 1)]
    with pytest.raises(RuntimeError, match="statistics must be 4 float32 on cpu, got .3"):
        optim.observe_(torch.zeros(3), *three[1:], radii, gradient)
    with pytest.raises(RuntimeError, match="statistics must be contiguous"):
        optim.observe_(torch.zeros(8)[::2], *three[1:], radii, gradient)
    with pytest.raises(RuntimeError, match="radii must be int32, got torch.float32"):
        optim.observe_(*three, radii.float(), gradient)
    wanted = "the gradient must be .4, 3. float32 on cpu, or its lengths .4,., got .4, 2. torch.float32"
    with pytest.raises(RuntimeError, match=wanted):
        optim.observe_(*three, radii, gradient[:, :2])
    optim.observe_(torch.zeros(0), torch.zeros(0, 1), torch.zeros(0, 1), radii[:0], gradient[:0])
