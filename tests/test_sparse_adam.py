"""Sparse Adam: the kernel against the formula in double, and the Gaussians of a model that take a step."""

import pytest
import torch
from diff_gaussian_rasterization.optim import sparse_adam_
from gaussians import GROUPS, model, moments, options, parameters, take_steps

from scene.gaussian_model import GaussianModel

RATE, BETAS, EPS = 0.01, (0.9, 0.999), 1e-15


def _formula(value, gradient, mean, square, seen) -> None:
    """Do one step in double on the rows seen, with Adam's moments and no bias correction."""
    mean[seen] = BETAS[0] * mean[seen] + (1 - BETAS[0]) * gradient[seen]
    square[seen] = BETAS[1] * square[seen] + (1 - BETAS[1]) * gradient[seen] ** 2
    value[seen] -= RATE * mean[seen] / (square[seen].sqrt() + EPS)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("shape", [(300, 3), (300, 1), (300, 15, 3)])
def test_it_is_the_formula_and_leaves_unseen_rows_alone(shape, dtype):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
    ours = [start.clone(), torch.zeros_like(start), torch.zeros_like(start)]
    exact = [t.double() for t in ours]
    never = torch.arange(300) % 7 == 0
    for _ in range(20):
        gradient = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
        seen = (torch.rand(300, generator=generator) < 0.5) & ~never
        before = [t.clone() for t in ours]
        sparse_adam_(ours[0], gradient, *ours[1:], seen, RATE, *BETAS, EPS)
        _formula(exact[0], gradient.double(), *exact[1:], seen)
        for old, new in zip(before, ours, strict=True):
            assert torch.equal(old[~seen], new[~seen])
    assert torch.equal(ours[0][never], start[never]) and (ours[0] - start).abs().max() > 5 * RATE
    unit = torch.finfo(dtype).eps
    # Twenty steps of up to 0.1, each exact to some units of values of 4. Uncorrected m / sqrt(v) is at first up to 3.2.
    torch.testing.assert_close(ours[0].double(), exact[0], rtol=0, atol=40 * unit * (4 + 20 * 3.2 * RATE))
    for got, wanted in zip(ours[1:], exact[1:], strict=True):
        torch.testing.assert_close(got.double(), wanted, rtol=0, atol=40 * unit * wanted.abs().max().item())


@pytest.mark.parametrize("columns", [0, 9])
def test_columns_left_out_are_not_touched(columns):
    generator = torch.Generator().manual_seed(1)
    state = [torch.randn(50, 45, generator=generator), torch.zeros(50, 45), torch.zeros(50, 45)]
    before = [t.clone() for t in state]
    gradient, seen = torch.randn(50, 45, generator=generator), torch.arange(50) % 2 == 0
    sparse_adam_(state[0], gradient, *state[1:], seen, RATE, *BETAS, EPS, columns)
    for old, new in zip(before, state, strict=True):
        assert torch.equal(old[:, columns:], new[:, columns:]) and torch.equal(old[~seen], new[~seen])
        assert columns == 0 or (old[seen, :columns] != new[seen, :columns]).all()


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
