"""Models and loops as other people write them: other classes, overridden getters, replaced activations, own loops."""

import argparse
import math

import pytest
import torch
from gaussians import FURTHER, GROUPS, STANDARD, append, cloud, model, options, parameters, pipeline
from torch import Tensor, nn

from gaussian_renderer import GaussianModel, render
from scene.cameras import MiniCam
from scene.gaussians.attributes import attributes
from utils.general_utils import inverse_sigmoid
from utils.graphics_utils import getProjectionMatrix
from utils.system_utils import UserError

WIDTH, HEIGHT = 41, 27
BLACK = torch.zeros(3)
CLOSE = {"rtol": 0, "atol": 5e-6}  # activations in the kernels and in PyTorch are rounded differently
UPRIGHT = torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1)
OLD = argparse.Namespace(convert_SHs_python=False, compute_cov3D_python=False, debug=False)  # the 2023 release's


def _camera(dtype: torch.dtype = torch.float32) -> MiniCam:
    """A camera at (0, 0, -3) facing +z."""
    view = torch.eye(4, dtype=dtype)
    view[2, 3] = 3.0
    projection = torch.as_tensor(getProjectionMatrix(0.01, 100.0, 0.9, 0.6)).to(dtype)
    return MiniCam(WIDTH, HEIGHT, 0.6, 0.9, 0.01, 100.0, view.T.contiguous(), (projection @ view).T.contiguous())


def _image(pc: object, camera: MiniCam | None = None, pipe: object = OLD, **more: object) -> Tensor:
    return render(camera or _camera(), pc, pipe, BLACK, **more)["render"]


# Cameras and pipes


def test_a_view_may_have_matrices_of_doubles_and_a_row_as_its_centre():
    gaussians = model(40)
    for in_python in (False, True):
        pipe = pipeline(convert_SHs_python=in_python)
        wanted = _image(gaussians, pipe=pipe)
        double, row = _camera(torch.float64), _camera()
        row.camera_center = row.camera_center[None]
        torch.testing.assert_close(_image(gaussians, double, pipe), wanted, **CLOSE)
        assert torch.equal(_image(gaussians, row, pipe), wanted)


def test_the_2023_release_has_no_antialiasing_and_the_colours_in_the_sixth_place():
    gaussians = model(40)
    colors = torch.rand(40, 3)
    old = render(_camera(), gaussians, OLD, BLACK, 0.7, colors)
    new = render(_camera(), gaussians, pipeline(), BLACK, 0.7, False, colors)
    assert torch.equal(old["render"], new["render"]) and old["depth"].shape == (1, HEIGHT, WIDTH)


def test_points_on_the_screen_have_gradients_while_anything_trains():
    gaussians = model(40)
    gaussians._xyz.requires_grad_(False)
    package = render(_camera(), gaussians, OLD, BLACK)
    package["render"].sum().backward()
    assert package["viewspace_points"].grad[:, :2].any()


# Models


def _foreign(gaussians: GaussianModel, degree: int) -> object:
    """Another project's model, with what the reference's renderer reads."""
    of = {
        "get_xyz": lambda _: gaussians._xyz,
        "get_features": lambda _: torch.cat((gaussians._features_dc, gaussians._features_rest), dim=1),
        "get_opacity": lambda _: torch.sigmoid(gaussians._opacity),
        "get_scaling": lambda _: torch.exp(gaussians._scaling),
        "get_rotation": lambda _: nn.functional.normalize(gaussians._rotation),
    }
    methods = {"get_covariance": lambda _, scaling_modifier=1: gaussians.get_covariance(scaling_modifier)}
    properties = {name: property(getter) for name, getter in of.items()}
    return type("Foreign", (), {"active_sh_degree": degree, **properties, **methods})()


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("in_python", [False, True])
def test_any_class_with_the_getters_is_rendered(degree, in_python):
    ours = model(40)
    ours.active_sh_degree = degree
    weights = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    pipe = argparse.Namespace(convert_SHs_python=in_python, compute_cov3D_python=in_python, debug=False)
    images, gradients = [], []
    for pc in (ours, _foreign(ours, degree)):
        images.append(_image(pc, pipe=pipe, scaling_modifier=0.8, separate_sh=False))
        (images[-1] * weights).sum().backward()
        gradients.append({name: getattr(ours, field).grad for name, field in GROUPS.items()})
        ours.optimizer.zero_grad(set_to_none=True)
    torch.testing.assert_close(*images, **CLOSE)
    for name, gradient in gradients[1].items():
        if gradients[0][name] is not None:
            assert (gradients[0][name] - gradient).abs().max() <= 1e-5 * gradient.abs().max(), name


class Wrapped:
    """Hands every name on to a model of ours, but those that it overrides."""

    def __init__(self, gaussians: GaussianModel) -> None:
        self._of = gaussians

    def __getattr__(self, name: str) -> object:
        return getattr(self._of, name)


def _own_activations(gaussians: GaussianModel) -> None:
    gaussians.scaling_activation = nn.functional.softplus
    gaussians.scaling_inverse_activation = lambda x: x + torch.log(-torch.expm1(-x))


CHANGES = {  # a getter that is overridden, and the columns of a model that looks the same
    "get_opacity": (lambda self: torch.ones(40, 1), {"opacity": torch.full((40, 1), 30.0)}),
    "get_scaling": (lambda self: torch.full((40, 3), 0.05), {"scaling": torch.full((40, 3), math.log(0.05))}),
    "get_rotation": (lambda self: UPRIGHT.clone(), {"rotation": UPRIGHT}),
    "get_features": (
        lambda self: torch.zeros(40, 16, 3),
        {"f_dc": torch.zeros(40, 1, 3), "f_rest": torch.zeros(40, 15, 3)},
    ),
}


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("name", CHANGES)
def test_overridden_getters_are_what_is_rendered(name, wrapped):
    getter, columns = CHANGES[name]
    gaussians, expected = model(40), model(40)
    plain = _image(expected)
    expected.set_rows(parameters(expected) | columns)
    client = type("Client", (Wrapped if wrapped else GaussianModel,), {name: property(getter)})
    if wrapped:
        torch.testing.assert_close(_image(Wrapped(gaussians)), plain, **CLOSE)
        gaussians = client(gaussians)
    else:
        gaussians.__class__ = client
    image = _image(gaussians)
    torch.testing.assert_close(image, _image(expected), **CLOSE)
    assert (image - plain).abs().max() > 0.01


def test_a_getter_replaced_in_the_class_is_seen_at_once(monkeypatch):
    """Those of single bands count where the reference reads them."""
    gaussians = model(40)
    plain = _image(gaussians)
    with monkeypatch.context() as patch:
        patch.setattr(GaussianModel, "get_opacity", property(lambda self: 0.5 * torch.sigmoid(self._opacity)))
        assert (_image(gaussians) - plain).abs().max() > 0.01
    assert torch.equal(_image(gaussians), plain)
    monkeypatch.setattr(GaussianModel, "get_features_dc", property(lambda self: torch.ones_like(self._features_dc)))
    assert torch.equal(_image(gaussians), plain)
    assert not torch.equal(_image(gaussians, separate_sh=True), plain)


def test_replaced_activations_are_what_is_rendered():
    gaussians = model(40)
    wanted = _image(gaussians)
    scales = gaussians.get_scaling.detach()
    _own_activations(gaussians)
    assert not torch.allclose(_image(gaussians), wanted, **CLOSE)
    with torch.no_grad():
        gaussians._scaling.copy_(gaussians.scaling_inverse_activation(scales))
    torch.testing.assert_close(_image(gaussians), wanted, **CLOSE)


def test_density_control_follows_replaced_activations():
    """The same scales and opacities by other activations give the same Gaussians."""
    plain, other = model(60), model(60)

    def activate(x: Tensor) -> Tensor:
        return 0.5 + 0.5 * torch.tanh(x)

    other.opacity_activation, other.inverse_opacity_activation = activate, lambda y: torch.atanh(2 * y - 1)
    _own_activations(other)
    with torch.no_grad():
        other._scaling.copy_(other.scaling_inverse_activation(plain.get_scaling))
        other._opacity.copy_(other.inverse_opacity_activation(plain.get_opacity))
        plain._opacity[0], other._opacity[0] = -9.0, -4.5
    for gaussians in (plain, other):
        gaussians.xyz_gradient_accum, gaussians.denom = torch.arange(60.0)[:, None], torch.ones(60, 1)
        gaussians.densify_and_prune(30.0, 0.005, 20.0, 20, seed=4, iteration=1)
    assert len(plain) == len(other) > 60
    for name in ("get_xyz", "get_scaling", "get_opacity"):
        torch.testing.assert_close(getattr(other, name), getattr(plain, name), rtol=1e-4, atol=1e-5)
    for gaussians in (plain, other):
        gaussians.reset_opacity()
        assert gaussians.get_opacity.max() < 0.0101
    torch.testing.assert_close(other.get_opacity, plain.get_opacity, rtol=1e-3, atol=1e-6)


def test_activations_have_the_references_names_and_forms():
    gaussians, x = model(10), torch.tensor([[0.3, 0.6]])
    assert gaussians.scaling_activation is torch.exp and gaussians.scaling_inverse_activation is torch.log
    assert gaussians.opacity_activation is torch.sigmoid and gaussians.inverse_opacity_activation is inverse_sigmoid
    assert torch.equal(gaussians.rotation_activation(x), nn.functional.normalize(x))
    packed = gaussians.covariance_activation(gaussians.get_scaling, 1.5, gaussians._rotation)
    assert torch.equal(packed, gaussians.get_covariance(1.5)) and packed.shape == (10, 6)
    gaussians.opacity_activation = torch.relu
    assert torch.equal(gaussians.get_opacity, torch.relu(gaussians._opacity)) and not gaussians.kernels_activate


def test_statistics_are_plain_attributes():
    gaussians = model(10)
    gaussians.denom = torch.full((10, 1), 3.0)
    assert gaussians.statistics.denom is gaussians.denom and "denom" in vars(gaussians)
    del gaussians.xyz_gradient_accum
    gaussians.prune_points(torch.arange(10) < 4)
    assert len(gaussians) == len(gaussians.denom) == 6 and not hasattr(gaussians, "xyz_gradient_accum")

    class Bare(GaussianModel):
        def __init__(self) -> None:
            self.max_radii2D = self.xyz_gradient_accum = self.denom = torch.empty(0)
            self.exposure_mapping, self.tmp_radii = {"a": 0}, None

    bare = Bare()
    assert bare.statistics.denom is bare.denom and bare.exposure_mapping == {"a": 0}


# Loops


@pytest.mark.parametrize(("restored", "degree"), [(False, 3), (True, 3), (False, 0), (False, 1)])
@pytest.mark.parametrize("kind", ["default", "sparse_adam"])
def test_every_band_with_a_gradient_trains(kind, restored, degree):
    """Whatever set the degree, and whatever reads the coefficients, such as a regulariser."""
    gaussians = model(20, active=False, optimizer_type=kind)
    gaussians.oneupSHdegree()
    if restored:
        gaussians.restore(gaussians.capture(), options())
    gaussians.active_sh_degree = degree
    before = parameters(gaussians)["f_rest"]
    for _ in range(2):
        gaussians._features_rest.square().sum().backward()
        gaussians.optimizer.step(*([torch.ones(20, dtype=torch.bool)] if kind == "sparse_adam" else []))
        gaussians.optimizer.zero_grad()
    assert (gaussians._features_rest != before).all()


def test_options_of_the_2023_release_are_enough():
    names = ("position_lr_init", "position_lr_final", "position_lr_delay_mult", "position_lr_max_steps", "feature_lr",
             "opacity_lr", "scaling_lr", "rotation_lr", "percent_dense")  # fmt: skip
    gaussians = GaussianModel(3)
    gaussians.create_from_pcd(cloud(20), 1.5)
    assert gaussians.spatial_lr_scale == 1.5 and gaussians.get_exposure.shape == (0, 3, 4)
    gaussians.training_setup(argparse.Namespace(**{name: getattr(options(), name) for name in names}))
    gaussians.update_learning_rate(7)
    assert gaussians.exposure_scheduler_args(0) == pytest.approx(0.01)
    assert gaussians.exposure_scheduler_args(30_000) == pytest.approx(0.001)
    keyword = GaussianModel(0)
    keyword.create_from_pcd(pcd=cloud(20), spatial_lr_scale=1.5)
    assert keyword.spatial_lr_scale == 1.5


@pytest.mark.parametrize("change", ["slice", "transpose", "plain", "cut", "load"])
def test_tensors_assigned_from_outside_train(change, tmp_path):
    gaussians = model(20)
    if change == "slice":
        gaussians.max_sh_degree = gaussians.active_sh_degree = 2
        gaussians._features_rest = gaussians._features_rest[:, :8]
    elif change == "transpose":
        gaussians._xyz = nn.Parameter(gaussians._xyz.detach().T.contiguous().T)
    elif change == "plain":
        gaussians._scaling = gaussians.scaling_inverse_activation(gaussians.get_scaling * 0.5)
        gaussians._opacity = gaussians._opacity.detach() * 0.9
    elif change == "cut":
        gaussians = model(40)
        for field in GROUPS.values():
            setattr(gaussians, field, nn.Parameter(getattr(gaussians, field).detach()[::2]))
    else:
        gaussians.save_ply(tmp_path / "a.ply")
        gaussians = GaussianModel(3)
        gaussians.load_ply(tmp_path / "a.ply")
        assert all(getattr(gaussians, field).is_contiguous() for field in GROUPS.values())
        gaussians.spatial_lr_scale = 1.0
    held = gaussians._xyz
    gaussians.training_setup(options())
    before = parameters(gaussians)
    _image(gaussians).sum().backward()
    gaussians.optimizer.step()
    after = parameters(gaussians)
    assert not any(torch.equal(after[name], before[name]) for name in STANDARD)
    assert gaussians._xyz is held  # parameters stay the same objects
    gaussians.prune_points(torch.arange(20) < 3)
    gaussians.save_ply(tmp_path / "a.ply")
    again = GaussianModel(gaussians.max_sh_degree)
    again.load_ply(tmp_path / "a.ply")
    assert torch.equal(again._features_rest, gaussians._features_rest)


def test_the_degree_follows_what_is_assigned(tmp_path):
    gaussians = model(6)
    assert gaussians.construct_list_of_attributes()[:10] == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0",
    ]  # fmt: skip
    every = len(gaussians.construct_list_of_attributes())
    assert every == 62 + sum(len(attributes(0)[name].columns) for name in FURTHER)
    gaussians._features_rest = nn.Parameter(gaussians._features_rest.detach()[:, :3].contiguous())
    assert len(gaussians.construct_list_of_attributes()) == every - 36
    gaussians.save_ply(tmp_path / "a.ply")
    gaussians.max_sh_degree = 1
    gaussians.load_ply(tmp_path / "a.ply")
    assert gaussians._features_rest.shape == (6, 3, 3) and gaussians.active_sh_degree == 1
    gaussians._features_rest = nn.Parameter(torch.zeros(6, 5, 3))
    with pytest.raises(UserError, match="5 SH coefficients above band 0, those of no SH degree"):
        gaussians.save_ply(tmp_path / "b.ply")


# Density control


def _ready(count: int = 30) -> GaussianModel:
    """A model of which half is cloned or split: the Gaussians with odd index."""
    gaussians = model(count)
    gaussians.xyz_gradient_accum, gaussians.denom = torch.arange(float(count))[:, None] % 2, torch.ones(count, 1)
    return gaussians


@pytest.mark.parametrize("dtype", [torch.int32, torch.float32])
def test_radii_follow_their_gaussians(dtype):
    """A client's own order of the steps: each row keeps the radius of its origin, told by its rotation."""
    gaussians = _ready()
    with torch.no_grad():
        gaussians._rotation[:, 0] = torch.arange(30.0) + 1
        gaussians._scaling[::4] = -6.0
        gaussians._scaling[1::4] = -6.0
    gaussians.tmp_radii = (torch.arange(30) + 1).to(dtype)
    grads = gaussians.xyz_gradient_accum / gaussians.denom
    gaussians.densify_and_clone(grads, 0.5, 20.0)
    assert len(gaussians) == 38 and torch.equal(gaussians.tmp_radii[30:], 1 + torch.arange(1, 30, 4).to(dtype))
    gaussians.densify_and_split(grads, 0.5, 20.0)
    assert len(gaussians) == 45
    gaussians.prune_points(torch.arange(45) % 5 == 0)
    assert gaussians.tmp_radii.dtype == dtype and len(gaussians.tmp_radii) == 36
    assert torch.equal(gaussians._rotation[:, 0], gaussians.tmp_radii.float())
    append(gaussians, 2)
    assert gaussians.tmp_radii[36:].tolist() == [0, 0]
    append(gaussians, 1, torch.tensor([5]))
    assert gaussians.tmp_radii[38:].tolist() == [5]


@pytest.mark.parametrize("radii", [None, torch.arange(30)])
def test_an_override_gets_as_many_arguments_as_there_are_values(radii):
    gaussians, seen = _ready(), []

    class Client(GaussianModel):
        def densification_postfix(self, *new: Tensor, **others: Tensor) -> None:
            seen.append(len(new))
            super().densification_postfix(*new, **others)

        def densify_and_split(self, grads: Tensor, grad_threshold: float, scene_extent: float, N: int = 2) -> None:
            seen.append("split")
            super().densify_and_split(grads, grad_threshold, scene_extent, N)

    gaussians.__class__ = Client
    gaussians.densify_and_prune(0.5, 0.005, 20.0, 20, radii)
    count = len(STANDARD) + (radii is not None)
    assert seen == [count, "split", count] and gaussians.tmp_radii is None and len(gaussians) > 30


def test_without_a_seed_torchs_generator_decides():
    children = []
    for seed in (5, None, 5):
        if seed is not None:
            torch.manual_seed(seed)
        gaussians = _ready()
        gaussians.densify_and_prune(0.5, 0.005, 20.0, None)
        children.append(gaussians.get_xyz.detach())
    assert torch.equal(children[0], children[2]) and children[0].shape == children[1].shape
    assert not torch.equal(children[0], children[1])


def test_three_children_are_smaller_than_two():
    """Each of N has 1 / (0.8 N) of the scale, as in the reference."""
    gaussians = _ready(2)
    scaling = gaussians._scaling.detach().clone()
    gaussians.densify_and_split(torch.ones(2, 1), 0.5, 0.0, N=3)
    assert torch.equal(gaussians._scaling, torch.cat([scaling] * 3) - math.log(0.8 * 3))
