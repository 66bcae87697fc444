"""Sparse Adam: the Gaussians of a model that take a step, and the class that the package has for other programs."""

import io

import pytest
import torch
from diff_gaussian_rasterization import SparseGaussianAdam
from gaussians import GROUPS, model, moments, options, parameters, take_steps
from test_gaussian_optimizer import groups, values
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import SparseGaussianAdam as OfTheModel


def _give_gradients(gaussians: GaussianModel, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for name in GROUPS.values():
        param = getattr(gaussians, name)
        param.grad = torch.randn(param.shape, generator=generator)


def test_a_model_steps_what_the_view_saw():
    gaussians = model(20, optimizer_type="sparse_adam")
    _give_gradients(gaussians, 0)
    gaussians.step(torch.full((20,), 5, dtype=torch.int32))
    values, state = parameters(gaussians), moments(gaussians)
    _give_gradients(gaussians, 1)
    radii = torch.tensor([3, 0] * 10, dtype=torch.int32)
    gaussians.step(radii)
    for name, value in parameters(gaussians).items():
        moved = (value != values[name]).reshape(20, -1).all(dim=1)
        assert torch.equal(moved, radii > 0)
        now = moments(gaussians)[name]
        assert torch.equal(now["exp_avg"][1::2], state[name]["exp_avg"][1::2])
        assert now["step"] == 2  # the tensor's counter, for resuming with the dense optimiser
    assert all(getattr(gaussians, name).grad is None for name in GROUPS.values())


def test_density_control_and_checkpoints_are_the_dense_optimisers():
    gaussians = model(20, optimizer_type="sparse_adam")
    _give_gradients(gaussians, 0)
    gaussians.step(torch.ones(20, dtype=torch.int32))
    gaussians.prune_points(torch.arange(20) < 5)
    before = parameters(gaussians)
    gaussians.step(torch.ones(20, dtype=torch.int32))  # the radii are from before, and no parameter has a gradient
    assert all(torch.equal(before[name], value) for name, value in parameters(gaussians).items())
    dense = model(3)
    dense.restore(gaussians.capture(), options())
    take_steps(dense, 1)
    assert moments(dense)["xyz"]["step"] == 2


def give_gradients(optimizer: torch.optim.Optimizer, seed: int) -> Tensor:
    """Sets gradients and returns the rows that are visible."""
    generator = torch.Generator().manual_seed(seed)
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.randn(group["params"][0].shape, generator=generator)
    return torch.rand(50, generator=generator) < 0.5


def column_major(tensor: Tensor) -> Tensor:
    return tensor.mT.contiguous().mT


@pytest.mark.parametrize("kind", [SparseGaussianAdam, OfTheModel])
@pytest.mark.parametrize("what", ["nothing", "parameters", "gradients", "visible", "loaded averages"])
def test_steps_are_those_of_the_models_optimiser_whatever_the_strides(kind, what):
    plain, odd = OfTheModel(groups()), kind(groups(), lr=0.0, eps=1e-15) if kind is not OfTheModel else kind(groups())
    start, params = values(plain), [group["params"][0] for group in odd.param_groups]
    if what == "parameters":  # of (N, 3) points, as the reference's reader makes them; before or after the first step
        for param in params:
            param.data = column_major(param.data)
    for seed in range(3):
        visible = give_gradients(plain, seed)
        give_gradients(odd, seed)
        if what == "gradients":
            for param in params:
                param.grad = column_major(param.grad)
        elif what == "loaded averages" and seed:
            state = odd.state_dict()
            for of_one in state["state"].values():
                of_one |= {name: column_major(of_one[name]) for name in ("exp_avg", "exp_avg_sq")}
            odd.load_state_dict(state)
        plain.step(visible)
        count = (len(visible),) if kind is SparseGaussianAdam and seed else ()
        odd.step(torch.stack([visible] * 2, 1)[:, 0] if what == "visible" else visible, *count)
        for got, wanted in zip(values(odd), values(plain), strict=True):
            assert torch.equal(got, wanted)
    assert not torch.equal(start[0], values(odd)[0])
    assert all(param is group["params"][0] for param, group in zip(params, odd.param_groups, strict=True))


def test_it_is_an_adam_of_torch():
    optimizer = SparseGaussianAdam(groups(), 0.0, 1e-15)
    assert isinstance(optimizer, torch.optim.Adam)
    rates = [group["lr"] for group in optimizer.param_groups]
    assert rates == [group["lr"] for group in groups()]
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)
    visible = give_gradients(optimizer, 0)
    optimizer.step(visible)
    schedule.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(rates[0] / 2)
    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    file.seek(0)
    again = SparseGaussianAdam(groups(), 0.0, 1e-15)
    again.load_state_dict(torch.load(file, weights_only=True))
    states = [[*each.state_dict()["state"].values()] for each in (again, optimizer)]
    assert len(states[0]) == 4
    for one, other in zip(*states, strict=True):
        assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_several_parameters_in_a_group_are_refused():
    params = [torch.nn.Parameter(torch.zeros(4, 3)) for _ in range(2)]
    with pytest.raises(ValueError, match="one parameter in each group, got 2"):
        SparseGaussianAdam(params, lr=0.1, eps=1e-15).step(torch.ones(4, dtype=torch.bool))
