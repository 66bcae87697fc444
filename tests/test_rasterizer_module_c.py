"""diff_gaussian_rasterization._C: the functions of the reference's compiled module, against the public ones."""

import itertools

import pytest
import torch
from diff_gaussian_rasterization import _C, GaussianRasterizer, optim
from rasterizer_tools import CPU_AND_GPU, activated, few, leaves
from torch import Tensor

from tests.workloads.splat_scenes import move_camera, settings

EMPTY = torch.Tensor([])


def scene(colors: bool, covariances: bool, device: str = "cpu", **changes):
    """Leaves by the reference's names, and a camera."""
    raw, size = few(3, dtype=torch.float32)
    splats = activated(raw)
    inputs = {
        "means3D": splats["means"],
        "means2D": torch.zeros(3, 3),
        "opacities": splats["opacities"],
        "shs": torch.cat([splats["sh_dc"], splats["sh_rest"]], 1),
        "colors_precomp": torch.rand(3, 3, generator=torch.Generator().manual_seed(0)),
        "scales": splats["scales"],
        "rotations": splats["rotations"],
        "cov3D_precomp": 0.05 * torch.eye(3)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].repeat(3, 1),
    }
    for name in ("shs",) if colors else ("colors_precomp",):
        del inputs[name]
    for name in ("scales", "rotations") if covariances else ("cov3D_precomp",):
        del inputs[name]
    moved = {name: values.to(device) for name, values in inputs.items()}
    return leaves(moved), move_camera(settings(**size, **changes), device)


def forward_arguments(inputs, camera) -> tuple:
    """In the order of the 2024 release."""
    of = {name: values.detach() for name, values in inputs.items()}.get
    shape = of("scales", EMPTY), of("rotations", EMPTY), camera.scale_modifier, of("cov3D_precomp", EMPTY)
    matrices = camera.viewmatrix, camera.projmatrix, camera.tanfovx, camera.tanfovy
    size, rest = (camera.image_height, camera.image_width), (camera.prefiltered, camera.antialiasing, camera.debug)
    colors, harmonics = (of("colors_precomp", EMPTY), of("opacities")), (camera.sh_degree, camera.campos)
    return camera.bg, of("means3D"), *colors, *shape, *matrices, *size, of("shs", EMPTY), *harmonics, *rest


def backward(given: tuple, count: int, radii: Tensor, buffers: list, *gradients: Tensor) -> tuple:
    """The gradients of a forward with these arguments and results; `gradients` are those of the planes."""
    places = *given[:2], radii, *given[2:12], *gradients, *given[14:17], buffers[0], count, *buffers[1:], *given[-2:]
    return _C.rasterize_gaussians_backward(*places)


@CPU_AND_GPU
@pytest.mark.parametrize(("colors", "covariances", "antialiasing"), list(itertools.product((False, True), repeat=3)))
def test_forward_and_backward_are_those_of_the_class(colors, covariances, antialiasing, device):
    inputs, camera = scene(colors, covariances, device, antialiasing=antialiasing)
    wanted = GaussianRasterizer(camera)(**inputs)
    generator = torch.Generator().manual_seed(1)
    gradients = [torch.randn(image.shape, generator=generator).to(device) for image in wanted[::2]]
    torch.autograd.backward(wanted[::2], gradients)

    given = forward_arguments(inputs, camera)
    count, color, radii, *buffers, depth = _C.rasterize_gaussians(*given)
    assert isinstance(count, int) and count > 0
    for got, image in zip((color, radii, depth), wanted, strict=True):
        assert torch.equal(got, image) and not got.requires_grad
    assert all(buffer.dtype == torch.uint8 and buffer.dim() == 1 for buffer in buffers)

    got = backward(given, count, radii, buffers, *gradients)
    names = "means2D", "colors_precomp", "opacities", "means3D", "cov3D_precomp", "shs", "scales", "rotations"
    for name, gradient in zip(names, got, strict=True):
        if name in inputs:
            assert torch.equal(gradient, inputs[name].grad), name
        else:
            assert len(gradient) == 3 and not gradient.any(), name


def test_looser_forms_of_the_camera_give_the_same_image_and_gradients():
    inputs, camera = scene(False, False)
    given = forward_arguments(inputs, camera)
    loose = list(given)
    for place, shape in {0: (1, 3), 8: (1, 4, 4), 9: (1, 4, 4), 16: (3, 1)}.items():
        loose[place] = given[place].reshape(shape)
    loose[12:14] = map(float, given[12:14])
    results = []
    for arguments in (given, loose):
        count, color, radii, *buffers, depth = _C.rasterize_gaussians(*arguments)
        results.append([color, *backward(arguments, count, radii, buffers, color, depth)])
    for got, wanted in zip(*results, strict=True):
        assert torch.equal(got, wanted)


def test_called_as_in_2023_there_is_no_inverse_depth():
    inputs, camera = scene(False, False)
    given = forward_arguments(inputs, camera)
    of_2024, of_2023 = _C.rasterize_gaussians(*given), _C.rasterize_gaussians(*given[:-2], False)
    assert len(of_2024) == 7 and len(of_2023) == 6
    for got, wanted in zip(of_2023, of_2024, strict=False):
        assert torch.equal(torch.as_tensor(got), torch.as_tensor(wanted))


def test_without_gaussians_both_ways():
    inputs, camera = scene(False, False)
    given = forward_arguments({name: values[:0] for name, values in inputs.items()}, camera)
    count, color, radii, *buffers, _ = _C.rasterize_gaussians(*given)
    assert count == 0 and torch.equal(color, camera.bg[:, None, None].expand_as(color)) and radii.shape == (0,)
    assert all(len(gradient) == 0 for gradient in backward(given, count, radii, buffers, color, EMPTY))


def test_buffers_of_another_rendering_are_refused():
    inputs, camera = scene(False, False)
    given = forward_arguments(inputs, camera)
    count, color, radii, *buffers, depth = _C.rasterize_gaussians(*given)
    for place in range(3):
        wrong = list(buffers)
        wrong[place] = wrong[place][:-4]
        with pytest.raises(ValueError, match="the buffer must be the one of this rendering"):
            backward(given, count, radii, wrong, color, depth)


def test_mark_visible():
    view = torch.eye(4)
    view[3, 2] = 1.0
    camera = scene(False, False)[1]._replace(viewmatrix=view)
    positions = torch.tensor([[0.0, 0, 0], [0, 0, -0.5], [0, 0, -0.9], [99.0, 99, 0], [0, 0, float("nan")]])
    visible = GaussianRasterizer(camera).markVisible(positions)
    assert visible.dtype == torch.bool and visible.tolist() == [True, True, False, True, False]
    assert GaussianRasterizer(camera).markVisible(positions[:0]).shape == (0,)
    assert torch.equal(_C.mark_visible(positions, view, camera.projmatrix), visible)


def test_a_step_of_adam():
    generator = torch.Generator().manual_seed(0)
    param = torch.nn.Parameter(torch.randn(6, 5, 3, generator=generator))
    gradient, seen = torch.randn(6, 5, 3, generator=generator), torch.arange(6) % 2 == 0
    ours = [param.detach().clone(), torch.zeros(6, 5, 3), torch.zeros(6, 5, 3)]
    theirs = [param, torch.zeros(6, 5, 3), torch.zeros(6, 5, 3)]
    optim.sparse_adam_(ours[0], gradient, *ours[1:], seen, 0.1, 0.9, 0.999, 1e-15)
    assert _C.adamUpdate(theirs[0], gradient, *theirs[1:], seen, 0.1, 0.9, 0.999, 1e-15, 6, 15) is None
    for got, wanted in zip(theirs, ours, strict=True):
        assert torch.equal(got, wanted)
