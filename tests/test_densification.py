"""Adaptive density control: the reference's rules on toy sets, its windows, and Adam's state after it."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, moments, options, parameters, take_steps
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import begun

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from splatting.checks import late_reset
from splatting.features.time_budget_schedule import Block, Decided, DecidedSchedule
from splatting.part import Needs
from splatting.schedule import Schedule
from utils.general_utils import build_rotation

EXTENT = 2.0
LIMIT = 0.01 * EXTENT  # percent_dense * extent
THRESHOLD = 2e-4


def _toy(scales: list[float], gradients: list[float], opacity: float = 0.5) -> GaussianModel:
    """One Gaussian per entry: a largest scale in world units and a mean gradient, seen in 4 views."""
    gaussians = model(len(scales), extent=EXTENT)
    take_steps(gaussians, 2)
    with torch.no_grad():
        gaussians._scaling[:, 0] = torch.tensor(scales, dtype=torch.float64).log().float()
        gaussians._scaling[:, 1:] = gaussians._scaling[:, :1] - 1
        gaussians._opacity.fill_(math.log(opacity / (1 - opacity)))
    gaussians.denom.fill_(4)
    gaussians.xyz_gradient_accum = 4 * torch.tensor(gradients)[:, None]
    gaussians.max_radii2D.fill_(100)
    return gaussians


def _densify(gaussians: GaussianModel, screen: int | None = None, **more: int) -> None:
    gaussians.densify_and_prune(THRESHOLD, rules.MIN_OPACITY, EXTENT, screen, **more)


def test_selection_at_equality():
    """g >= threshold grows; s <= limit clones, s > limit splits."""
    threshold = torch.tensor(THRESHOLD).item()  # what float32 makes of it, so that four views of it average to it
    below = torch.nextafter(torch.tensor(threshold), torch.tensor(0.0)).item()
    limit = math.exp(math.log(LIMIT))
    above = limit * (1 + 1e-5)
    gaussians = _toy([limit, limit, above, above, limit], [threshold, below, threshold, below, 1.0])
    before = parameters(gaussians)
    gaussians.densify_and_prune(threshold, rules.MIN_OPACITY, EXTENT, None)
    # The order is: kept 0, 1, 3, 4 (2 was split), then clones of 0 and 4, then two children of 2.
    assert torch.equal(parameters(gaussians)["f_dc"], before["f_dc"][[0, 1, 3, 4, 0, 4, 2, 2]])


def test_clones_and_children_inherit_from_their_own_parent():
    """Use several of each kind, so that a wrong order of rows shows."""
    gaussians = _toy([LIMIT / 2] * 3 + [LIMIT * 3] * 3, [1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    before = parameters(gaussians)
    _densify(gaussians)
    assert gaussians.denom.shape == (10, 1) and gaussians.max_radii2D.shape == (10,)
    assert not any(values.any() for values in vars(gaussians.statistics).values())
    # The order is: kept 0, 1, 2, 4 (3 and 5 were split), clones of 0 and 2, first children of 3 and 5, second ones.
    origin = [0, 1, 2, 4, 0, 2, 3, 5, 3, 5]
    for name, value in parameters(gaussians).items():
        assert name in ("opacity", "scaling") or not torch.equal(value[6], value[7])
        expected = before[name][origin]
        if name == "scaling":
            expected[6:] -= math.log(1.6)
        if name == "xyz":
            value, expected = value[:6], expected[:6]
        assert torch.equal(value, expected), name


class Replacing(GaussianModel):
    """A client that replaces a step, and so gets its own call."""

    def densify_and_clone(self, grads: torch.Tensor, *others: float) -> None:
        before = len(self)
        super().densify_and_clone(grads, *others)
        self.cloned = len(self) - before


class TakingNorms(Replacing):
    """The reference's own line: over gradients (N,) its norm would be one number for all."""

    def densify_and_clone(self, grads: torch.Tensor, *others: float) -> None:
        super().densify_and_clone(torch.norm(grads, dim=-1), *others)

    def densify_and_split(self, grads: torch.Tensor, *others: float, **how: int) -> None:
        assert grads.shape == (300, 1)
        super().densify_and_split(grads, *others, **how)


@pytest.mark.parametrize("client", [Replacing, TakingNorms])
def test_clones_and_splits_at_once_give_the_bytes_of_one_after_the_other(client, screen=20):
    generator, models = torch.Generator().manual_seed(7), []
    scales = (LIMIT * 20 ** (2 * torch.rand(300, generator=generator) - 1)).tolist()  # up to twice what is pruned
    gradients = (2 * THRESHOLD * torch.rand(300, generator=generator)).tolist()
    for kind in (GaussianModel, client):
        gaussians = _toy(scales, gradients)
        gaussians.__class__ = kind
        with torch.no_grad():
            gaussians._opacity[::7] = -6.0
        _densify(gaussians, screen=screen, seed=3, iteration=700)
        models.append(gaussians)
    ours, theirs = models
    assert theirs.cloned > 20 and len(ours) == len(theirs) != 300
    for name, value in parameters(ours).items():
        assert torch.equal(value, parameters(theirs)[name]), name
        for key, average in moments(ours)[name].items():
            assert torch.equal(average, moments(theirs)[name][key]), (name, key)


def test_reset_lowers_opacities_to_a_hundredth():
    gaussians = _toy([LIMIT] * 3, [0.0] * 3)
    with torch.no_grad():
        gaussians._opacity[0] = -6.0
    gaussians.reset_opacity()
    low = torch.tensor(rules.logit(0.01), dtype=torch.float32).item()
    assert gaussians._opacity.reshape(-1).tolist() == [-6.0, low, low]
    assert gaussians.get_opacity[1:].detach().numpy() == pytest.approx(0.01)


def test_pruning():
    gaussians = _toy([LIMIT] * 6, [0.0] * 6)
    low = rules.logit(rules.MIN_OPACITY)
    with torch.no_grad():
        gaussians._opacity[0] = low - 1e-3
        gaussians._opacity[1] = low + 1e-3
        gaussians._scaling[2, 1] = math.log(0.1 * EXTENT) + 1e-3
        gaussians._scaling[3, 1] = math.log(0.1 * EXTENT) - 1e-3
    kept = gaussians._xyz.detach().clone()
    _densify(gaussians, screen=None)
    assert torch.equal(gaussians._xyz, kept[1:])  # no sizes before the first opacity reset
    _densify(gaussians, screen=20)
    # max_radii2D was 100, yet no Gaussian was removed for its screen size: the reference zeroes it just before.
    assert torch.equal(gaussians._xyz, kept[[1, 3, 4, 5]])


def test_children_are_drawn_from_their_parent():
    """The whitened offsets of many children have mean 0 and covariance 1 in the parent's own frame."""
    n = 20_000
    scaling = torch.tensor([0.5, -1.0, -3.0]).repeat(n, 1)
    rotation = torch.tensor([0.9, -0.4, 1.3, 0.2]).repeat(n, 1)
    centre = torch.tensor([1.0, -2.0, 0.5]).repeat(n, 1)
    children, scales = rules.split_children(centre, scaling, rotation, torch.arange(n), 0, seed=3, iteration=600)
    offset = (children - centre).double() @ build_rotation(rotation[:1].double())[0] / scaling.double().exp()
    assert offset.mean(0).abs().max() < 4 / math.sqrt(n)
    assert (offset.T @ offset / n - torch.eye(3)).abs().max() < 4 * math.sqrt(2 / n)
    assert torch.equal(scales, scaling - math.log(1.6))
    again, _ = rules.split_children(centre[:5], scaling[:5], rotation[:5], torch.arange(5), 0, seed=3, iteration=600)
    assert torch.equal(again, children[:5])
    other, _ = rules.split_children(centre[:5], scaling[:5], rotation[:5], torch.arange(5), 1, seed=3, iteration=600)
    assert (other != again).all()


def test_windows_of_the_defaults():
    opt = options()
    todo = {t: rules.actions(t, opt, white_background=False) for t in range(1, 30_001)}
    assert [t for t in todo if todo[t].densify] == list(range(600, 15_000, 100))
    assert [t for t in todo if todo[t].reset_opacity] == [3000, 6000, 9000, 12_000]
    assert [t for t in todo if todo[t].observe] == list(range(1, 15_000))
    assert [t for t in todo if todo[t].densify and todo[t].limit_size] == list(range(3100, 15_000, 100))
    white = [t for t in range(1, 30_001) if rules.actions(t, opt, white_background=True).reset_opacity]
    assert white == [500, 3000, 6000, 9000, 12_000]


def test_never_seen_gaussians_have_no_gradient():
    assert rules.mean_gradient(torch.tensor([[0.0], [3.0]]), torch.tensor([[0.0], [2.0]])).tolist() == [0.0, 1.5]


def test_statistics_take_indices_and_masks():
    gaussians = model(4)
    points = torch.zeros(4, 3, requires_grad=True)
    points.grad = torch.tensor([[3.0, 4.0, 100.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    gaussians.add_densification_stats(points, torch.tensor([[0], [3]]))
    gaussians.add_densification_stats(points, torch.tensor([True, False, True, False]))
    assert gaussians.xyz_gradient_accum.reshape(-1).tolist() == [10.0, 0.0, 2.0, 0.0]
    assert gaussians.denom.reshape(-1).tolist() == [2.0, 0.0, 1.0, 1.0]


def _views(gaussians: GaussianModel, views: int, seed: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Screen points with a gradient, and radii, of some views; each leaves a third of the Gaussians unseen."""
    generator = torch.Generator().manual_seed(seed)
    result = []
    for _ in range(views):
        points = torch.zeros(len(gaussians), 3)
        size = 10 ** (4 * torch.rand(len(gaussians), 1, generator=generator) - 6)
        points.grad = torch.randn(points.shape, generator=generator) * size
        radii = torch.randint(-30, 60, (len(gaussians),), generator=generator, dtype=torch.int32).clamp_min(0)
        result.append((points, radii))
    return result


def test_a_view_in_one_pass_is_its_two_parts():
    """Compare observe with max_radii2D and add_densification_stats in torch, and to the bit with NumPy."""
    fused, plain = model(3001), model(3001)
    exact = np.zeros(3001, dtype=np.float32)
    for points, radii in _views(fused, 7, seed=0):
        fused.observe(points, radii)
        torch.maximum(plain.max_radii2D, radii, out=plain.max_radii2D)
        plain.add_densification_stats(points, radii > 0)
        x, y, _ = points.grad.numpy().T
        exact += np.where(radii > 0, np.sqrt(x * x + y * y), np.float32(0))
    assert fused.denom.max() == 7 and fused.max_radii2D.max() > 0
    assert torch.equal(fused.max_radii2D, plain.max_radii2D) and torch.equal(fused.denom, plain.denom)
    assert torch.equal(fused.xyz_gradient_accum.reshape(-1), torch.from_numpy(exact))
    # torch's square root is sometimes off by a unit in the last place.
    torch.testing.assert_close(fused.xyz_gradient_accum, plain.xyz_gradient_accum, rtol=2 * 2**-23, atol=0)


def test_the_cap_takes_the_largest_gradients_ties_by_index():
    gradient = torch.tensor([5.0, 1.0, 5.0, 7.0, 5.0, 0.5])
    assert rules.limit_growth(gradient, 1.0, 3).nonzero().reshape(-1).tolist() == [0, 2, 3, 5]
    assert rules.limit_growth(gradient, 1.0, 0).tolist() == [0, 0, 0, 0, 0, 0.5]
    assert rules.limit_growth(gradient, 1.0, -2).tolist() == [0, 0, 0, 0, 0, 0.5]
    assert torch.equal(rules.limit_growth(gradient, 1.0, 5), gradient)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 30), cap=st.integers(1, 50), seed=st.integers(0, 2**16))
def test_the_cap_is_never_passed_and_reached_when_it_can(count, cap, seed):
    generator = torch.Generator().manual_seed(seed)
    scales = (LIMIT * (0.5 + torch.rand(count, generator=generator))).tolist()
    gradients = (2 * THRESHOLD * torch.rand(count, generator=generator)).tolist()
    gaussians = _toy(scales, gradients)
    candidates = int((rules.mean_gradient(gaussians.xyz_gradient_accum, gaussians.denom) >= THRESHOLD).sum())
    _densify(gaussians, max_splats=cap)
    assert len(gaussians) == max(count, min(cap, count + candidates))


LEFT_OUT = [
    ({"iterations": 7000}, False, [3000]),
    ({"iterations": 7500}, False, [3000, 6000]),  # with half of an interval to go
    ({"iterations": 30_000}, False, [3000, 6000, 9000, 12_000]),  # all, as densification ends at 15,000
    ({"iterations": 700, "opacity_reset_interval": 300, "densify_from_iter": 50}, True, [50, 300]),
    ({"iterations": 1999}, True, []),
    ({"iterations": 2000}, True, [500]),
    ({"iterations": 7000, "opacity_reset_interval": 100_000}, True, [500]),  # as it has no others
]


@pytest.mark.parametrize(("changes", "white", "kept"), LEFT_OUT)
def test_a_reset_with_less_than_half_an_interval_to_go_is_left_out(changes, white, kept):
    opt = options(**changes)
    control = begun("adc", model(4), opt, Schedule(opt.iterations), white=white)
    every = range(1, changes["iterations"])
    assert [t for t in every if control.actions(t).reset_opacity] == kept
    regular = [t for t in kept if t != opt.densify_from_iter]
    recovers = {t for t in every if control.actions(t).recovers}
    assert sorted(t for t in recovers if t - 1 not in recovers) == regular
    left = changes["iterations"] - kept[-1] if kept else rules.RECOVERY
    assert (late_reset(control, opt, 0) is None) == (left >= rules.RECOVERY)


def test_a_run_by_the_clock_recovers_from_no_reset_that_it_leaves_out():
    """3,000 steps in 300 iterations: too few for a reset."""
    schedule = DecidedSchedule(Decided(30_000, [Block(3000, 0.0, 1 / 3000, 0.0)], 3000, 9.0))
    control = begun("adc", model(4), schedule=schedule, white=True)
    assert not any(one.reset_opacity or one.recovers for one in map(control.actions, range(1, 3000)))


@pytest.mark.parametrize(("allowed", "interval", "resets"), [(True, 3000, 5), (False, 3000, 0), (False, 2500, 6)])
def test_a_part_may_want_no_resets(allowed, interval, resets):
    parts = [SimpleNamespace(needs=Needs(resets=allowed))]
    opt = options(opacity_reset_interval=interval)
    control = begun("adc", model(4), opt, Schedule(30_000), white=True, parts=parts)
    assert sum(control.actions(t).reset_opacity for t in range(1, 30_000)) == resets
    assert opt.opacity_reset_interval == interval
