"""Our Adam, dense and sparse, against torch's: steps, states, inactive bands, and memory."""

import copy
import weakref

import pytest
import torch
from diff_gaussian_rasterization import SparseGaussianAdam
from gaussians import model, options, take_steps

from scene.gaussians.adam import GaussianAdam


def groups(seed: int = 0) -> list[dict]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"xyz": (50, 3), "f_dc": (50, 1, 3), "opacity": (50, 1), "f_rest": (50, 15, 3)}
    return [
        {"params": [torch.nn.Parameter(torch.randn(shape, generator=generator))], "lr": rate, "name": name}
        for (name, shape), rate in zip(shapes.items(), (1e-2, 2e-2, 5e-2, 1e-3), strict=True)
    ]


def values(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    params = [group["params"][0] for group in optimizer.param_groups]
    return [t.detach().clone() for p in params for t in (p, *optimizer.state[p].values())]


def _step(optimizers: list[torch.optim.Optimizer], generator: torch.Generator, *visible: object) -> None:
    for groups in zip(*(optimizer.param_groups for optimizer in optimizers), strict=True):
        # Gradients of very different sizes, some exactly zero, like those of a rasterizer.
        shape = groups[0]["params"][0].shape
        gradient = torch.randn(shape, generator=generator) * 10 ** (-8 * torch.rand(shape, generator=generator))
        gradient[::5] = 0
        for group in groups:
            group["params"][0].grad = gradient.clone()
    for optimizer in optimizers:
        optimizer.step(*visible)


def test_steps_and_states_are_those_of_torch():
    """Take 50 steps; after 25 a new optimiser of each kind goes on from the state dict of the other."""
    ours = GaussianAdam(groups())
    theirs = torch.optim.Adam(groups(), lr=0.0, eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for step in range(50):
        if step == 25:
            new = GaussianAdam(groups()), torch.optim.Adam(groups(), lr=0.0, eps=1e-15)
            for optimizer, other in zip(new, (theirs, ours), strict=True):
                optimizer.load_state_dict(copy.deepcopy(other.state_dict()))
                for mine, group in zip(optimizer.param_groups, other.param_groups, strict=True):
                    mine["params"][0].data.copy_(group["params"][0].detach())
            ours, theirs = new
        ours.param_groups[0]["lr"] = theirs.param_groups[0]["lr"] = 1e-2 * 0.97**step
        _step([ours, theirs], generator)
    for mine, other in zip(ours.param_groups, theirs.param_groups, strict=True):
        a, b = mine["params"][0], other["params"][0]
        # 50 steps, each a few roundings of a parameter of size 4 (2^-22) and of a step of size lr.
        assert (a - b).abs().max() < 50 * 2**-22
        state, expected = ours.state[a], theirs.state[b]
        assert state.keys() == expected.keys()
        assert torch.equal(state["step"], expected["step"]) and state["step"].dtype == expected["step"].dtype
        # Means of gradients of size 4 may cancel. Squares cannot, so they agree relatively.
        torch.testing.assert_close(state["exp_avg"], expected["exp_avg"], rtol=0, atol=2**-22)
        torch.testing.assert_close(state["exp_avg_sq"], expected["exp_avg_sq"], rtol=1e-5, atol=0)


@pytest.mark.parametrize("kind", [GaussianAdam, SparseGaussianAdam])
def test_parameters_without_gradient_stay_and_do_not_count(kind):
    """The sparse one does not read the rows then, which are of before a densification."""
    optimizer = kind(groups(), lr=0.0, eps=1e-15) if kind is SparseGaussianAdam else kind(groups())
    visible = [torch.ones(50, dtype=torch.bool), 50] if kind is SparseGaussianAdam else []
    _step([optimizer], torch.Generator().manual_seed(0), *visible)
    optimizer.zero_grad(set_to_none=True)
    before = values(optimizer)
    optimizer.step(*([torch.ones(7, dtype=torch.bool), 7] if visible else []))
    assert all(torch.equal(*pair) for pair in zip(values(optimizer), before, strict=True))


@pytest.mark.parametrize("columns", [0, 9, 24])
def test_leaving_out_inactive_bands_changes_no_bit(columns):
    """A dense step of columns with zero gradient and moments equals the step that skips them."""
    dense, sparse = GaussianAdam(groups()), GaussianAdam(groups())
    sparse.set_active_columns("f_rest", columns)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        for a, b in zip(dense.param_groups, sparse.param_groups, strict=True):
            gradient = torch.randn(a["params"][0].shape, generator=generator)
            if a["name"] == "f_rest":
                gradient.view(len(gradient), -1)[:, columns:] = 0
            a["params"][0].grad, b["params"][0].grad = gradient, gradient.clone()
            if a["name"] == "f_rest" and columns == 0:
                b["params"][0].grad = None
        dense.step()
        sparse.step()
    assert all(torch.equal(*pair) for pair in zip(values(dense), values(sparse), strict=True))


@pytest.mark.parametrize("with_gradient", ["f_dc", "opacity"])
def test_inactive_bands_count_along_with_the_base_colour(with_gradient):
    optimizer = GaussianAdam(groups())
    optimizer.set_active_columns("f_rest", 0)
    param = {group["name"]: group["params"][0] for group in optimizer.param_groups}
    param[with_gradient].grad = torch.ones_like(param[with_gradient])
    optimizer.step()
    counted = {name for name, value in param.items() if optimizer.state.get(value)}
    assert counted == ({"f_dc", "f_rest"} if with_gradient == "f_dc" else {"opacity"})


def test_groups_are_the_references():
    optimizer = model(3, extent=2.0).optimizer
    opt = options()
    rates = {
        "xyz": opt.position_lr_init * 2, "f_dc": opt.feature_lr, "f_rest": opt.feature_lr / 20,
        "opacity": opt.opacity_lr, "scaling": opt.scaling_lr, "rotation": opt.rotation_lr,
    }  # fmt: skip
    assert [(group["name"], group["lr"]) for group in optimizer.param_groups][:6] == list(rates.items())
    assert all(group["eps"] == 1e-15 and group["betas"] == (0.9, 0.999) for group in optimizer.param_groups)


def test_while_rows_change_no_more_than_one_tensor_is_there_twice():
    """Once a parameter or average has its new rows, nobody has the old ones."""
    gaussians = model(50)
    gaussians.training_setup(options())
    take_steps(gaussians, 1)
    old, left = [], []

    def change(values: torch.Tensor) -> torch.Tensor:
        left.append(sum(one() is not None for one in old))
        old.append(weakref.ref(values.untyped_storage()))
        return values.clone()

    gaussians.table.change(change, gaussians.table.row_groups())
    assert len(left) >= 21 and not any(left)
