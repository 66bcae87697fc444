"""Rows that come and go under any optimiser of torch, judged by torch.optim.Adam on the rows that are left."""

import copy
from collections.abc import Callable

import pytest
import torch
from gaussians import GROUPS, append, model, options, parameters
from torch import Tensor, nn

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam, SparseGaussianAdam

EXTENT = 20.0  # Gaussians of 0.2 and less are cloned, larger ones split, and those of more than 2 removed
ADAM = {"lr": 0.0, "eps": 1e-15}
OPTIMIZERS = {
    "ours": GaussianAdam,
    "adam": lambda groups: torch.optim.Adam(groups, **ADAM),
    "amsgrad": lambda groups: torch.optim.Adam(groups, amsgrad=True, **ADAM),
    "rmsprop": lambda groups: torch.optim.RMSprop(groups, momentum=0.5, centered=True),
    "adagrad": lambda groups: torch.optim.Adagrad(groups),
    "sgd": lambda groups: torch.optim.SGD(groups, lr=0.1, momentum=0.9),
    "plain sgd": lambda groups: torch.optim.SGD(groups, lr=0.1),
}


def _groups(gaussians: GaussianModel) -> list[dict]:
    return [{"params": [getattr(gaussians, f)], "lr": 0.01, "name": name} for name, f in GROUPS.items()]


def _with(make: Callable, count: int = 30) -> GaussianModel:
    """A model whose optimiser is the client's."""
    gaussians = model(count)
    gaussians.optimizer = make(_groups(gaussians))
    return gaussians


def _gradients(gaussians: GaussianModel, seed: int, rows: Tensor) -> dict[str, Tensor]:
    """Random gradients of 30 Gaussians by group, of which `rows` are chosen."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {name: getattr(gaussians, f).shape[1:] for name, f in GROUPS.items()}
    return {name: torch.randn(30, *shape, generator=generator)[rows] for name, shape in shapes.items()}


def _step(gaussians: GaussianModel, seed: int, rows: Tensor) -> None:
    for name, gradient in _gradients(gaussians, seed, rows).items():
        getattr(gaussians, GROUPS[name]).grad = gradient
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad(set_to_none=True)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_pruned_rows_train_on_as_if_they_had_always_been_alone(name):
    every, keep = torch.arange(30), torch.arange(0, 30, 3)
    gaussians, alone = _with(OPTIMIZERS[name]), model(30)
    alone.set_rows({group: values[keep] for group, values in parameters(alone).items()})
    alone.optimizer = OPTIMIZERS[name](_groups(alone))
    for seed in range(3):
        _step(gaussians, seed, every)
        _step(alone, seed, keep)
    gaussians.prune_points(torch.ones(30, dtype=torch.bool).index_fill_(0, keep, False))
    assert len(gaussians) == len(gaussians.denom) == len(gaussians.max_radii2D) == 10
    assert all(getattr(gaussians, field).grad is None for field in GROUPS.values())
    for seed in range(3, 6):
        _step(gaussians, seed, keep)
        _step(alone, seed, keep)
    torch.testing.assert_close(parameters(gaussians), parameters(alone), rtol=1e-6, atol=1e-6)
    assert set(gaussians.optimizer.state) <= {getattr(gaussians, field) for field in GROUPS.values()}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_permuted_rows_train_on_as_in_the_order_before(name):
    order = torch.randperm(30, generator=torch.Generator().manual_seed(5))
    gaussians, still = _with(OPTIMIZERS[name]), _with(OPTIMIZERS[name])
    gaussians.max_radii2D, gaussians.tmp_radii = torch.arange(30.0), torch.arange(30)
    _step(gaussians, 0, torch.arange(30))
    _step(still, 0, torch.arange(30))
    gaussians.table.permute(order)
    assert gaussians.max_radii2D.tolist() == gaussians.tmp_radii.tolist() == order.tolist()
    _step(gaussians, 1, order)
    _step(still, 1, torch.arange(30))
    for group, values in parameters(still).items():
        assert torch.equal(parameters(gaussians)[group], values[order]), group


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_appended_rows_start_with_averages_of_zero(name):
    gaussians = _with(OPTIMIZERS[name])
    _step(gaussians, 0, torch.arange(30))
    before = {group["name"]: dict(gaussians.optimizer.state[group["params"][0]]) for group in _groups(gaussians)}
    append(gaussians, 4)
    assert len(gaussians) == 34 and all(group["params"][0] is getattr(gaussians, GROUPS[group["name"]])
                                        for group in gaussians.optimizer.param_groups)  # fmt: skip
    for group in gaussians.optimizer.param_groups:
        state = gaussians.optimizer.state[group["params"][0]]
        for key, old in before[group["name"]].items():
            if torch.is_tensor(old) and old.dim():
                assert torch.equal(state[key][:30], old) and not state[key][30:].any()
            else:
                assert state[key] == old
    _step(gaussians, 1, torch.arange(34) % 30)


def test_a_reset_restarts_averages_and_keeps_the_counter():
    gaussians = _with(OPTIMIZERS["amsgrad"])
    _step(gaussians, 0, torch.arange(30))
    params = gaussians.replace_tensor_to_optimizer(torch.full((30, 1), 2.0), "opacity")
    assert list(params) == ["opacity"] and gaussians.replace_tensor_to_optimizer(torch.zeros(1), "none") == {}
    state = gaussians.optimizer.state[params["opacity"]]
    assert state["step"] == 1 and not any(state[key].any() for key in ("exp_avg", "exp_avg_sq", "max_exp_avg_sq"))
    assert params["opacity"].requires_grad and params["opacity"].grad is None
    # As in the reference, the model's own attribute is the caller's business.
    assert gaussians._opacity is not params["opacity"]
    smaller = gaussians.replace_tensor_to_optimizer(torch.zeros(7, 1), "opacity")["opacity"]
    assert gaussians.optimizer.state[smaller]["exp_avg"].shape == (7, 1)


# Groups that are not of the table


class _Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.layer = nn.Linear(4, 3)
        with torch.no_grad():
            for param in self.parameters():
                param.copy_(torch.randn(param.shape, generator=generator))


@pytest.mark.parametrize("make", [GaussianAdam, SparseGaussianAdam, OPTIMIZERS["adam"]])
def test_a_network_trains_beside_the_gaussians(make):
    """The weights, several in a group, follow torch's own Adam, and no row surgery touches them."""
    gaussians, network, judge = _with(make), _Network(), _Network()
    gaussians.optimizer.add_param_group({"params": network.parameters(), "lr": 0.01, "name": "network"})
    scale = nn.Parameter(torch.ones(5))
    gaussians.optimizer.add_param_group({"params": [scale], "lr": 0.01})
    theirs = torch.optim.Adam(judge.parameters(), lr=0.01, eps=1e-15)
    visible = (torch.ones(30, dtype=torch.bool), 30)
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        for mine, other in zip(network.parameters(), judge.parameters(), strict=True):
            mine.grad = torch.randn(mine.shape, generator=generator)
            other.grad = mine.grad.clone()
        scale.grad = torch.ones(5)
        for name, gradient in _gradients(gaussians, seed, torch.arange(len(gaussians))).items():
            getattr(gaussians, GROUPS[name]).grad = gradient
        if seed == 2:
            gaussians.prune_points(torch.arange(30) < 12)
            gaussians.reset_opacity()
            visible = (torch.ones(18, dtype=torch.bool), 18)
            assert all(param.grad is not None for param in network.parameters())
        gaussians.optimizer.step(*(visible if make is SparseGaussianAdam else ()))
        gaussians.optimizer.zero_grad(set_to_none=True)
        theirs.step()
        assert all(param.grad is None for param in (*network.parameters(), scale, gaussians._xyz))
    for mine, other in zip(network.parameters(), judge.parameters(), strict=True):
        assert torch.equal(mine, other)
    assert scale.max() < 1 and len(gaussians) == 18 and gaussians.optimizer.state[gaussians._xyz]["step"] >= 5


def test_the_state_of_a_network_comes_back_from_a_checkpoint():
    class Client(GaussianModel):
        def training_setup(self, training_args):
            super().training_setup(training_args)
            self.network = _Network()
            self.optimizer.add_param_group({"params": self.network.parameters(), "lr": 0.01, "amsgrad": True})

    gaussians, other = model(30), Client(3)
    gaussians.__class__ = Client
    gaussians.training_setup(options())
    for param in gaussians.network.parameters():
        param.grad = torch.full_like(param, 0.5)
    _step(gaussians, 0, torch.arange(30))
    other.restore(gaussians.capture(), options())
    for mine, theirs in zip(other.network.parameters(), gaussians.network.parameters(), strict=True):
        assert gaussians.optimizer.state[theirs]["max_exp_avg_sq"].any()
        for key, value in gaussians.optimizer.state[theirs].items():
            assert torch.equal(other.optimizer.state[mine][key], value)


def test_a_further_group_with_a_row_per_gaussian_is_pruned_along():
    gaussians = _with(GaussianAdam)
    feature = nn.Parameter(torch.arange(60.0).reshape(30, 2))
    gaussians.optimizer.add_param_group({"params": [feature], "lr": 0.1, "name": "feature"})
    feature.grad = torch.ones(30, 2)
    _step(gaussians, 0, torch.arange(30))
    before = feature.detach().clone()
    gaussians.prune_points(torch.arange(30) >= 5)
    now = gaussians.optimizer.param_groups[-1]["params"][0]
    assert torch.equal(now, before[:5]) and gaussians.optimizer.state[now]["exp_avg"].shape == (5, 2)
    rows = {name: values[:2] for name, values in parameters(gaussians).items()}
    with pytest.raises(ValueError, match="no rows are given for feature, which has a row for every Gaussian"):
        append(gaussians, 2)
    assert len(gaussians) == 5 == len(gaussians.optimizer.param_groups[0]["params"][0])
    params = gaussians.cat_tensors_to_optimizer(rows | {"feature": torch.zeros(2, 2)})
    assert set(params) == {*GROUPS, "feature"} and params["feature"].shape == (7, 2)
    kept = gaussians._prune_optimizer(torch.tensor([True, False] * 3 + [True]))
    assert torch.equal(kept["feature"], params["feature"][::2]) and len(kept["xyz"]) == 4


def test_attributes_that_are_not_optimised_keep_their_rows_in_step():
    gaussians = model(30)
    gaussians.optimizer = torch.optim.Adam([group for group in _groups(gaussians) if group["name"] != "rotation"])
    rotation = gaussians._rotation.detach().clone()
    gaussians.prune_points(torch.arange(30) < 10)
    assert torch.equal(gaussians._rotation, rotation[10:])
    append(gaussians, 3)
    assert torch.equal(gaussians._rotation, torch.cat((rotation[10:], rotation[10:13])))


# GaussianAdam's groups


ROWS = torch.linspace(-1, 1, 30).reshape(10, 3)


@pytest.mark.parametrize(
    ("start", "own"),
    [(ROWS, {"betas": (0.5, 0.9)}), (ROWS, {"eps": 1e-3}), (ROWS, {"weight_decay": 0.1}), (ROWS, {"amsgrad": True})]
    + [(ROWS, {"maximize": True}), *((other, {}) for other in (ROWS.double(), ROWS.T, ROWS[0, 0], ROWS.bfloat16()))],
)
def test_a_group_with_options_or_a_form_of_its_own_follows_torch(start, own):
    values = [nn.Parameter(start.clone()) for _ in range(2)]
    ours = GaussianAdam([{"params": [nn.Parameter(torch.ones(10, 3))], "lr": 0.1, "name": "xyz"}])
    ours.add_param_group({"params": [values[0]], "lr": 0.1, "name": "other", **own})
    theirs = torch.optim.Adam([{"params": [values[1]], **own}], lr=0.1, eps=own.get("eps", 1e-15))
    for step in range(5):
        for value in values:
            value.grad = torch.sin(torch.arange(value.numel()) + step).reshape(value.shape).to(value.dtype)
        ours.step()
        theirs.step()
    torch.testing.assert_close(*values, rtol=0, atol=0 if own else 1e-6)


def test_a_copy_of_a_model_trains_on_as_the_model_does():
    gaussians = model(20, active=False)
    gaussians.oneupSHdegree()
    other = copy.deepcopy(gaussians)
    for each in (gaussians, other):
        for seed in range(2):
            for name, gradient in _gradients(each, seed, torch.arange(20)).items():
                if name == "f_rest":
                    gradient[:, 3:] = 0
                getattr(each, GROUPS[name]).grad = gradient
            each.optimizer.step()
    assert all(torch.equal(values, parameters(other)[name]) for name, values in parameters(gaussians).items())
