"""Gradients of the camera: against central differences in float64 and the oracle, and through corrections of poses."""

import math

import pytest
import torch
from diff_gaussian_rasterization import reference
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.scene import draw, scene_arguments
from gaussians import model, pipeline
from rasterizer_tools import BOTH_AND_GPU, error, few, loss_of, move_camera, render, rigid
from torch import Tensor

from gaussian_renderer import render as render_model
from scene.cameras import MiniCam
from scene.poses import motion, moved
from tests.workloads.splat_scenes import settings

VIEW = rigid((0.95, 0.1, -0.15, 0.05), (0.1, -0.05, 0.2))
SHEARED = VIEW.clone()
SHEARED[:3, :3] = torch.tensor([[-1.1, 0.1, 0.0], [0.2, 0.8, 0.15], [0.0, -0.1, 0.9]], dtype=torch.float64)
FIELDS = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")
CHECK = {"eps": 1e-6, "atol": 1e-7, "rtol": 1e-6}  # as in test_rasterizer_gradients.py
LENSES = {
    "perspective": ((0.05, 0.02, -0.01, 0.002), (0.01, 0.01, -0.002), (0.003, -0.004), (0.002, 0.001)),
    "equidistant": ((-0.05, 0.02, -0.01, 0.002), (0.01, 0.01, -0.002), (0.003, -0.004), (0.002, 0.001)),
    "equirectangular": ((0.01, 0, 0, 0), (0, 0, 0), (0.003, -0.004), (0.002, 0.001)),
}


def _lens(chart: str) -> Lens:
    return Lens(chart, (16.0, 14.0), (8.0, 3.5), *LENSES[chart])


def _sums(parameters: dict[str, Tensor], camera, names: tuple[str, ...]):
    """All pixels of all planes, summed in three random ways, as a function of fields of the settings."""
    weights = torch.randn(3, 5 * 7 * 18, dtype=torch.float64, generator=torch.Generator().manual_seed(4)) / 25

    def sums(*values):
        out = render(parameters, camera._replace(**dict(zip(names, values, strict=True))))
        return weights @ torch.cat([out.color, out.inverse_depth, out.transmittance]).flatten()

    return sums


def _check(parameters: dict[str, Tensor], camera, names: tuple[str, ...]) -> None:
    inputs = [torch.as_tensor(getattr(camera, name), dtype=torch.float64).clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(_sums(parameters, camera, names), inputs, **CHECK)


@pytest.mark.parametrize(
    ("view", "degree", "antialiasing"), [(VIEW, 3, True), (SHEARED, 3, False), (SHEARED, 1, True), (VIEW, 0, False)]
)
def test_all_of_a_pinhole(view, degree, antialiasing):
    """Each partial derivative, also where view and projection change apart from each other."""
    parameters, size = few()
    camera = settings(**size, view=view, principal=(0.1, -0.1), sh_degree=degree, antialiasing=antialiasing)
    _check(parameters, camera, FIELDS)


def _gradient_of_numbers(parameters: dict[str, Tensor], camera) -> Tensor:
    """Return the gradient of a sum of all colours by the camera's numbers, by the operators."""
    scene = scene_arguments(Gaussians(**parameters), camera, True)
    drawn = draw(scene, camera.bg)
    source = drawn.kept(camera.bg)
    rows = OPERATORS.blend_rows(source, torch.ones_like(drawn.color))
    return OPERATORS.sum_blocks(OPERATORS.camera_vjp(*scene, [*source[:2], *rows]))


@pytest.mark.parametrize("lens", [None, "perspective"])
def test_clamped_rays(lens):
    """Gaussians beyond 1.3 half images follow the clamp's limit, which depends on principal point and focal length."""
    parameters, size = few(4)
    camera = settings(**size, principal=(0.1, -0.1), antialiasing=True, lens=lens and _lens(lens))
    for row, (axis, side) in enumerate([(0, 1), (0, -1), (1, 1), (1, -1)]):
        tan = (camera.tanfovx, camera.tanfovy)[axis]
        parameters["means"][row, :2] = 0
        parameters["means"][row, axis] = side * 1.7 * tan * parameters["means"][row, 2]
    parameters["scales"] += 0.5
    parameters["opacities"] += 1
    names = FIELDS
    if lens is not None:
        camera = camera._replace(lens_values=torch.tensor(camera.lens.values, dtype=torch.float64))
        names = ("viewmatrix", "campos", "lens_values")
    _check(parameters, camera, names)
    numbers = _gradient_of_numbers(parameters, camera)
    assert (numbers[15:19].abs() > 1e-4).all()  # all four limits hold somewhere


@pytest.mark.parametrize(("chart", "antialiasing"), list(zip(LENSES, (False, True, False), strict=True)))
def test_all_of_a_lens(chart, antialiasing):
    parameters, size = few()
    values = torch.tensor(_lens(chart).values, dtype=torch.float64)
    camera = settings(**size, view=VIEW, lens=_lens(chart), lens_values=values, antialiasing=antialiasing)
    _check(parameters, camera, ("viewmatrix", "campos", "lens_values"))


def test_values_take_the_place_of_the_lens():
    parameters, size = few()
    lens, other = _lens("perspective"), Lens("perspective", (15.0, 15.0), (9.0, 3.0))
    camera = settings(**size, lens=other, lens_values=torch.tensor(lens.values, dtype=torch.float64))
    assert torch.equal(render(parameters, camera).color, render(parameters, settings(**size, lens=lens)).color)
    assert lens.with_values(other.values) == other
    for wrong in (torch.ones(14), torch.ones(15, dtype=torch.int64), [1.0] * 15):
        with pytest.raises(ValueError, match="lens_values must be a tensor of 15 floats"):
            render(parameters, camera._replace(lens_values=wrong))


def _of_pose(camera, twist: Tensor, intrinsics: Tensor):
    """The settings of a pose in the camera's frame, and of focal lengths and principal point (NDC)."""
    view = camera.viewmatrix.double() @ motion(twist).T.to(camera.viewmatrix.device)
    projection = torch.zeros(4, 4, dtype=torch.float64, device=view.device)
    projection[0, 0], projection[1, 1], projection[2, 0], projection[2, 1] = intrinsics
    projection[2, 3] = 1
    made = {"viewmatrix": view, "projmatrix": view @ projection, "campos": torch.linalg.inv(view)[3, :3]}
    return camera._replace(**{name: value.to(camera.viewmatrix.dtype) for name, value in made.items()})


def _pose_gradients(parameters: dict[str, Tensor], camera, function, **options) -> tuple[Tensor, ...]:
    twist = torch.tensor([0.1, -0.05, 0.07, 0.2, -0.1, 0.1], dtype=torch.float64, requires_grad=True)
    intrinsics = [1 / camera.tanfovx, 1 / camera.tanfovy, 0.08, -0.05]
    intrinsics = torch.tensor(intrinsics, dtype=torch.float64, requires_grad=True)
    out = render(parameters, _of_pose(camera, twist, intrinsics), function=function, **options)
    return torch.autograd.grad(loss_of(out), [twist, intrinsics])


@BOTH_AND_GPU
@pytest.mark.parametrize("antialiasing", [False, True], ids=["plain alpha", "antialiased"])
def test_the_total_of_a_pose_is_the_oracles(antialiasing, device, dtype):
    """The oracle takes means from the full projection alone: partial derivatives differ, and totals do not."""
    parameters, size = few(40, 70, 33)
    parameters["means"][:, 2] = torch.linspace(1.5, 6, 40)
    parameters["scales"] -= 1.5
    camera = settings(**size, view=VIEW, antialiasing=antialiasing)
    wanted = _pose_gradients(parameters, camera, reference.render)
    moved_to = {name: t.to(device, dtype) for name, t in parameters.items()}
    camera = move_camera(settings(**(size | {"dtype": dtype}), view=VIEW, antialiasing=antialiasing), device)
    got = _pose_gradients(moved_to, camera, render.__kwdefaults__["function"])
    for one, two in zip(got, wanted, strict=True):
        # float32: some 1e-7 for each of 40 blends, where pixels' gradients of both signs nearly cancel.
        assert error(one.cpu(), two).largest < (1e-11 if dtype == torch.float64 else 2e-5)


def test_no_gaussian_is_seen():
    """A camera that looks away, and one of no Gaussians, get zeros."""
    parameters, size = few()
    for rows, side in ((3, -1), (0, 1)):
        view = settings(**size).viewmatrix.clone().requires_grad_()
        behind = {name: t[:rows].clone() for name, t in parameters.items()}
        behind["means"] *= side
        render(behind, settings(**size)._replace(viewmatrix=view)).color.sum().backward()
        assert torch.equal(view.grad, torch.zeros(4, 4, dtype=torch.float64))


def _minicam(view: Tensor) -> MiniCam:
    made = settings(18, 7, torch.float32, view=view)
    return MiniCam(18, 7, 0.5, math.radians(60), 0.01, 100.0, made.viewmatrix, made.projmatrix)


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_a_twist_moves_a_camera(frame):
    camera = _minicam(VIEW)
    same = moved(camera, torch.zeros(6), frame)
    for name in ("world_view_transform", "full_proj_transform", "camera_center"):
        assert torch.equal(getattr(same, name), getattr(camera, name))
    twist = torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.3], dtype=torch.float64)
    matrix = VIEW @ motion(twist) if frame == "world" else motion(twist) @ VIEW
    one, two = moved(camera, twist, frame), _minicam(matrix)
    for name in ("world_view_transform", "full_proj_transform", "camera_center"):
        torch.testing.assert_close(getattr(one, name), getattr(two, name), rtol=1e-6, atol=1e-6)


def test_a_pose_gets_its_gradient_through_render():
    camera, twist, gaussians = _minicam(VIEW), torch.zeros(6, requires_grad=True), model(40)
    with torch.no_grad():
        gaussians._xyz += torch.tensor([0.0, 0.0, 3.0])
    black = torch.zeros(3)

    def loss(twist: Tensor) -> Tensor:
        return render_model(moved(camera, twist), gaussians, pipeline(), black, clamp=False)["render"].square().sum()

    loss(twist).backward()
    step = 3e-3 * torch.eye(6)
    with torch.no_grad():
        wanted = torch.stack([(loss(h) - loss(-h)) / 6e-3 for h in step])
    # A float32 image, whose pixels gain and lose splats at 1/255.
    torch.testing.assert_close(twist.grad, wanted, rtol=0.02, atol=float(0.01 * wanted.abs().max()))


def test_a_motion_is_rigid_and_its_inverse_is_of_minus_the_twist():
    turn = torch.tensor([0.0, 0, math.pi / 2, 1, 0, 0], dtype=torch.float64)
    radius = 2 / math.pi  # of the quarter of a circle that the origin goes along
    wanted = [[0.0, -1, 0, radius], [1, 0, 0, radius], [0, 0, 1, 0], [0, 0, 0, 1]]
    torch.testing.assert_close(motion(turn), torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=1e-15)
    twist = torch.tensor([0.4, -1.2, 0.7, 3.0, -2.0, 0.1])
    torch.testing.assert_close(motion(twist) @ motion(-twist), torch.eye(4).double(), rtol=0, atol=1e-14)
    assert torch.equal(motion(torch.zeros(6)), torch.eye(4).double())
    assert torch.autograd.gradcheck(motion, torch.zeros(6, dtype=torch.float64, requires_grad=True))
