"""Our Adam against torch's, and the changes of its state when Gaussians come and go."""

import copy
import weakref

import pytest
import torch
from gaussians import model, options, take_steps

from scene.gaussians.adam import GaussianAdam


def _groups(seed: int = 0) -> list[dict]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"xyz": (50, 3), "f_dc": (50, 1, 3), "opacity": (50, 1), "f_rest": (50, 15, 3)}
    return [
        {"params": [torch.nn.Parameter(torch.randn(shape, generator=generator))], "lr": rate, "name": name}
        for (name, shape), rate in zip(shapes.items(), (1e-2, 2e-2, 5e-2, 1e-3), strict=True)
    ]


def _step(optimizers: list[torch.optim.Optimizer], generator: torch.Generator) -> None:
    for groups in zip(*(optimizer.param_groups for optimizer in optimizers), strict=True):
        # Gradients of very different sizes, some exactly zero, like those of a rasterizer.
        shape = groups[0]["params"][0].shape
        gradient = torch.randn(shape, generator=generator) * 10 ** (-8 * torch.rand(shape, generator=generator))
        gradient[::5] = 0
        for group in groups:
            group["params"][0].grad = gradient.clone()
    for optimizer in optimizers:
        optimizer.step()


def test_steps_follow_torch():
    ours = GaussianAdam(_groups())
    theirs = torch.optim.Adam(_groups(), lr=0.0, eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for step in range(50):
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


@pytest.mark.parametrize("direction", ["ours to torch", "torch to ours"])
def test_state_dicts_carry_over(direction):
    ours, theirs = GaussianAdam(_groups()), torch.optim.Adam(_groups(), lr=0.0, eps=1e-15)
    source, target = (ours, theirs) if direction == "ours to torch" else (theirs, ours)
    generator = torch.Generator().manual_seed(1)
    _step([source], generator)
    target.load_state_dict(copy.deepcopy(source.state_dict()))
    with torch.no_grad():
        for mine, other in zip(source.param_groups, target.param_groups, strict=True):
            other["params"][0].copy_(mine["params"][0])
    _step([ours, theirs], generator)
    for mine, other in zip(ours.param_groups, theirs.param_groups, strict=True):
        torch.testing.assert_close(mine["params"][0], other["params"][0], rtol=0, atol=2**-22)
        assert ours.state[mine["params"][0]]["step"] == 2


def test_parameters_without_gradient_stay_and_do_not_count():
    optimizer = GaussianAdam(_groups())
    _step([optimizer], torch.Generator().manual_seed(0))
    optimizer.zero_grad(set_to_none=True)
    before = [group["params"][0].detach().clone() for group in optimizer.param_groups]
    optimizer.step()
    for group, value in zip(optimizer.param_groups, before, strict=True):
        assert torch.equal(group["params"][0], value)
        assert optimizer.state[group["params"][0]]["step"] == 1


@pytest.mark.parametrize("columns", [0, 9, 24])
def test_leaving_out_inactive_bands_changes_no_bit(columns):
    """A dense step of columns with zero gradient and moments equals the step that skips them."""
    dense, sparse = GaussianAdam(_groups()), GaussianAdam(_groups())
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
    for a, b in zip(dense.param_groups, sparse.param_groups, strict=True):
        assert torch.equal(a["params"][0], b["params"][0])
        for key, value in dense.state[a["params"][0]].items():
            assert torch.equal(value, sparse.state[b["params"][0]][key])


@pytest.mark.parametrize("with_gradient", ["f_dc", "opacity"])
def test_inactive_bands_count_along_with_the_base_colour(with_gradient):
    optimizer = GaussianAdam(_groups())
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
