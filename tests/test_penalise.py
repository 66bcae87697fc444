"""The operator that adds the gradients of penalties on opacities and scales, and the model's use of it."""

import pytest
import torch
from diff_gaussian_rasterization.density import penalise_
from gaussians import model
from rasterizer_tools import BOTH_AND_GPU
from torch import Tensor

from scene.gaussians.penalty import NO_PENALTY, Penalty

WEIGHTS = {"opacity": 0.3, "scale": 0.7}


def _tensors(count: int) -> list[Tensor]:
    """Logits, log scales and gradients of both."""
    generator = torch.Generator().manual_seed(0)
    return [3 * torch.randn(count, width, generator=generator) for width in (1, 3, 1, 3)]


@BOTH_AND_GPU
@pytest.mark.parametrize("count", [0, 1, 7, 5001])
def test_gradients_are_autograds(count, device, dtype):
    tensors = [t.to(dtype) for t in _tensors(count)]
    exact = [t.double().requires_grad_() for t in tensors[:2]]
    (0.3 * exact[0].sigmoid().sum() + 0.7 * exact[1].exp().sum()).backward()
    got = [t.clone().to(device) for t in tensors]
    penalise_(*got, **WEIGHTS)
    bound = 1e-6 if dtype == torch.float32 else 1e-13
    for new, old, param in zip(got[2:], tensors[2:], exact, strict=True):
        torch.testing.assert_close(new.cpu(), (old.double() + param.grad).to(dtype), rtol=bound, atol=bound)


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_a_models_penalty_is_of_its_means(given, replaced):
    """The penalty counts all Gaussians, whatever their activations, with or without gradients of the image."""
    gaussians = model(30)
    if replaced:
        gaussians.opacity_activation = lambda x: x.sigmoid()
    params = gaussians._opacity, gaussians._scaling
    wanted = torch.autograd.grad(0.3 * params[0].sigmoid().mean() + 0.7 * params[1].exp().mean(), params)
    for param in params:
        param.grad = torch.ones_like(param) if given else None
    gaussians.add_penalty_gradients(Penalty(0.3, 0.7))
    for param, gradient in zip(params, wanted, strict=True):
        torch.testing.assert_close(param.grad, gradient + given)
    assert not any(NO_PENALTY)
