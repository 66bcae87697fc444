"""Derivatives that the kernels lack raise RuntimeError in every way in which torch asks for them; first ones work."""

import pytest
import torch
import torch.utils.checkpoint
from fused_ssim import fused_ssim
from fused_ssim.ops import fused_photometric_loss
from rasterizer_tools import activated, few, ops, render, scene_arguments
from torch import Tensor, autograd, func
from torch.autograd import forward_ad

from tests.workloads.splat_scenes import settings

RAW, SIZE = few(dtype=torch.float32)
SPLATS, CAMERA = activated(RAW), settings(**SIZE)
PHOTO = torch.rand(3, 12, 13, generator=torch.Generator().manual_seed(1))


def _sum_by_operator(means: Tensor) -> Tensor:
    scene = scene_arguments(SPLATS | {"means": means}, CAMERA, raw=False)
    return ops.rasterize(torch.zeros_like(means), *scene, CAMERA.bg, False, True)[0].sum()


# Scalar functions of a tensor, and a value of it. A sum has a constant gradient, and a square has not.
FUNCTIONS = {
    "sum": (lambda means: render(SPLATS | {"means": means}, CAMERA, raw=False).color.sum(), SPLATS["means"]),
    "square": (lambda means: (render(SPLATS | {"means": means}, CAMERA, raw=False).color ** 2).sum(), SPLATS["means"]),
    "SSIM": (lambda image: fused_ssim(image, PHOTO), PHOTO.flip(1).contiguous()),
    "loss": (lambda image: fused_photometric_loss(image, PHOTO, 0.2)[0], PHOTO.flip(1).contiguous()),
}


def _gradient(function, x: Tensor) -> tuple[Tensor, Tensor]:
    x = x.clone().requires_grad_()
    return x, autograd.grad(function(x), x, create_graph=True)[0]


def _penalty(function, x: Tensor) -> Tensor:
    x, gradient = _gradient(function, x)
    return autograd.grad(gradient.square().sum() + x.sum(), x)[0]


def _penalty_backward(function, x: Tensor) -> None:
    _gradient(function, x)[1].square().sum().backward()


def _dual(function, x: Tensor) -> Tensor:
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(function(forward_ad.make_dual(x, torch.ones_like(x)))).tangent


SECOND = {
    "penalty": _penalty,
    "penalty by backward": _penalty_backward,
    "functional.hvp": lambda f, x: autograd.functional.hvp(f, x, torch.ones_like(x)),
    "grad of grad": lambda f, x: func.grad(lambda y: func.grad(f)(y).sum())(x),
    "func.hessian": lambda f, x: func.hessian(f)(x),
    "jvp": lambda f, x: func.jvp(f, (x,), (torch.ones_like(x),)),
    "dual numbers": _dual,
}


@pytest.mark.parametrize("way", SECOND)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_no_derivative_is_silently_zero(function, way):
    with pytest.raises(RuntimeError, match="no second derivative|jvp|vmap"):
        SECOND[way](*FUNCTIONS[function])


# Called by themselves, operators drop tangents as every operator of torch's library does; so only reverse mode.
OPERATORS = {
    "rasterize": (_sum_by_operator, SPLATS["means"]),
    "the photometric loss": (lambda image: torch.ops.fused_ssim.photometric(image, PHOTO, 0.2, True)[0], PHOTO / 2),
}


@pytest.mark.parametrize("way", ["penalty", "penalty by backward"])
@pytest.mark.parametrize("name", OPERATORS)
def test_the_operators_themselves_raise_too(name, way):
    with pytest.raises(RuntimeError, match=f"{name} has no second derivative"):
        SECOND[way](*OPERATORS[name])


@pytest.mark.parametrize("function", FUNCTIONS)
def test_every_way_to_the_first_derivative_gives_the_same(function):
    function, x = FUNCTIONS[function]
    leaf = x.clone().requires_grad_()
    function(leaf).backward()
    ways = [_gradient(function, x)[1], func.grad(function)(x), func.jacrev(function)(x)]
    ways += [func.vjp(function, x)[1](torch.ones(()))[0], autograd.functional.jacobian(function, x, create_graph=True)]
    for gradient in ways:
        assert gradient.any() and torch.equal(gradient, leaf.grad)


def test_activation_checkpoints_allow_a_graph_of_the_gradient():
    function, means = FUNCTIONS["square"]
    leaf = means.clone().requires_grad_()
    value = torch.utils.checkpoint.checkpoint(function, leaf, use_reentrant=False)
    (gradient,) = autograd.grad(value, leaf, create_graph=True)
    assert torch.equal(gradient, _gradient(function, means)[1])


def test_a_tangent_elsewhere_is_no_reason_to_raise():
    function, means = FUNCTIONS["square"]
    assert torch.equal(_dual(lambda other: function(means) + other.sum(), means), torch.tensor(float(means.numel())))
