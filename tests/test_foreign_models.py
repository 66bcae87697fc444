"""Models and loops as other people write them: other classes, overridden getters, replaced activations, own loops."""

import argparse
import math

import pytest
import torch
from gaussians import GROUPS, STANDARD, cloud, model, options, parameters, pipeline
from torch import Tensor, nn

from gaussian_renderer import GaussianModel, render
from scene.cameras import MiniCam
from utils.general_utils import inverse_sigmoid
from utils.graphics_utils import getProjectionMatrix

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


def test_the_2023_release_has_no_antialiasing_and_the_colours_in_the_sixth_place():
    gaussians = model(40)
    colors = torch.rand(40, 3)
    old = render(_camera(), gaussians, OLD, BLACK, 0.7, colors)
    new = render(_camera(), gaussians, pipeline(), BLACK, 0.7, False, colors)
    assert torch.equal(old["render"], new["render"]) and old["depth"].shape == (1, HEIGHT, WIDTH)


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


def test_replaced_activations_are_what_is_rendered():
    gaussians = model(40)
    wanted = _image(gaussians)
    scales = gaussians.get_scaling.detach()
    _own_activations(gaussians)
    assert not torch.allclose(_image(gaussians), wanted, **CLOSE)
    with torch.no_grad():
        gaussians._scaling.copy_(gaussians.scaling_inverse_activation(scales))
    torch.testing.assert_close(_image(gaussians), wanted, **CLOSE)


def test_activations_have_the_references_names_and_forms():
    gaussians, x = model(10), torch.tensor([[0.3, 0.6]])
    assert gaussians.scaling_activation is torch.exp and gaussians.scaling_inverse_activation is torch.log
    assert gaussians.opacity_activation is torch.sigmoid and gaussians.inverse_opacity_activation is inverse_sigmoid
    assert torch.equal(gaussians.rotation_activation(x), nn.functional.normalize(x))
    packed = gaussians.covariance_activation(gaussians.get_scaling, 1.5, gaussians._rotation)
    assert torch.equal(packed, gaussians.get_covariance(1.5)) and packed.shape == (10, 6)
    gaussians.opacity_activation = torch.relu
    assert torch.equal(gaussians.get_opacity, torch.relu(gaussians._opacity)) and not gaussians.kernels_activate


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


# Density control


def _ready(count: int = 30) -> GaussianModel:
    """A model of which half is cloned or split: the Gaussians with odd index."""
    gaussians = model(count)
    gaussians.xyz_gradient_accum, gaussians.denom = torch.arange(float(count))[:, None] % 2, torch.ones(count, 1)
    return gaussians


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
