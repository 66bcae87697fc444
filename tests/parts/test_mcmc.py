"""The strategy `mcmc`: its rules (Kheradmand et al. 2024), and trainings by it."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import GROUPS, model, options, take_steps
from strategies import begun
from torch import Tensor
from trainings import MCMC, narrow_scene, train_on

from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from scene.saved_model import read_model
from splatting.features.mcmc_rules import MOST_PARTS, divided, draw, grow, relocate
from splatting.features.time_budget_schedule import Block, Decided, DecidedSchedule
from utils.system_utils import UserError


def _train(scene: Path, out: Path, *options: object, iterations: int = 60) -> dict[int, bytes]:
    words = "-r", 48, "--iterations", iterations, "--no_curve", "--quiet", "--strategy", "mcmc", "--disable_viewer"
    window = "--densify_from_iter", 10, "--densification_interval", 10
    return train_on(scene, out, *words, *window, "--test_iterations", -1, *options)


def test_every_part_has_an_effect(colmap_scene, tmp_path):
    names = "", "mcmc_noise", "mcmc_opacity_reg", "mcmc_scale_reg", "mcmc_init_scale"
    more = [(f"--{name}", 100) if name else () for name in names]
    plies = [_train(colmap_scene, tmp_path / f"{name}_", *MCMC[2:], *words, iterations=15)[15]
             for name, words in zip(names, more, strict=True)]  # fmt: skip
    assert len({*plies}) == len(names)


@pytest.mark.parametrize(("growth", "count", "grown"), [(0.05, 5, 6), (0.05, 40, 42), (0.0, 5, 5), (1.0, 30, 45)])
def test_a_few_gaussians_grow_at_least_by_one(growth, count, grown):
    control = begun("mcmc", opt=options(max_num_splats=45, mcmc_growth=growth))
    assert control._next_count(count, 600) == grown


def test_growth_ends_at_the_limit(colmap_scene, tmp_path):
    every, window = range(5, 60, 10), ("--mcmc_growth", 0.3, "--mcmc_until_iter", 50)
    # 10 is not above --densify_from_iter, 50 is not below --mcmc_until_iter. Nothing is removed.
    for limit, counts in ((0, [300, 300, 390, 507, 659, 659]), (430, [300, 300, 390, *[430] * 3]), (3, [300] * 6)):
        out = tmp_path / str(limit)
        _train(colmap_scene, out, "--max_num_splats", limit, *window, "--checkpoint_iterations", *every)
        assert [len(load_checkpoint(out / f"chkpnt{t}.pth")[0][1]) for t in every] == counts


@pytest.mark.parametrize(("stride", "random"), [(1.0, True), (10.0, True), (10.0, False)])
def test_a_random_start_larger_than_the_clock_can_train_loses_the_faintest(stride, random):
    """25 Gaussians for each iteration; without a clock, with enough of it, or else, nothing is removed."""
    gaussians = model(200)
    with torch.no_grad():
        gaussians._opacity[:, 0] = torch.linspace(2.0, -2.0, 200)
    kept = gaussians._xyz.detach().clone()
    schedule = DecidedSchedule(Decided(60, [Block(30, 0.0, stride / 60, 0.0)], None, 9.0))
    schedule.random = random
    begun("mcmc", gaussians, schedule=schedule)._relocate(1)
    left = 25 * 6 if random and stride == 10.0 else 200
    assert len(gaussians) == left and torch.equal(gaussians._xyz, kept[:left])


def test_the_start_is_more_opaque_and_smaller_than_the_points(colmap_scene, tmp_path):
    def start(name: str, *more: object) -> GaussianModel:
        _train(colmap_scene, tmp_path / name, "--save_iterations", 1, *more, iterations=2)
        return read_model(tmp_path / name / ply)

    ply = "point_cloud/iteration_1/point_cloud.ply"
    mcmc, adc = (start(name, "--strategy", name) for name in ("mcmc", "adc"))
    torch.testing.assert_close(mcmc.get_opacity, torch.full_like(mcmc._opacity, 0.5))
    torch.testing.assert_close(mcmc.get_scaling, 0.1 * adc.get_scaling)
    given = start("given", "--init_ply", tmp_path / "adc" / ply)
    torch.testing.assert_close(given.get_scaling, adc.get_scaling)  # a model brings its own shapes


def test_a_step_leaves_what_the_view_does_not_see(tmp_path):
    scene = narrow_scene(tmp_path / "scene")
    words = "--strategy", "mcmc", "--quiet", "--disable_viewer", "--no_curve", "--mcmc_noise", 0
    train_on(scene, tmp_path / "out", *words, "--iterations", 4, "--checkpoint_iterations", 2, 3)
    opacities = [load_checkpoint(tmp_path / "out" / f"chkpnt{t}.pth")[0][6] for t in (2, 3)]
    stayed = (opacities[0] == opacities[1]).float().mean()
    assert 0.5 < stayed < 0.99


def test_a_scene_that_fades_is_refused(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="above 0.9 in iteration 30: .*lower --mcmc_opacity_reg"):
        _train(colmap_scene, tmp_path, "--mcmc_min_opacity", 0.9)


# The rules, on raw parameters and on a model with its optimiser


LOGITS = torch.tensor([-5.2, -2.0, 0.0, 1.5, 4.0, 9.0, 15.0])
WHERE = {"seed": 3, "iteration": 600}
DRAW = WHERE | {"draw": 1}
LEAST = 0.005


@pytest.mark.parametrize("parts", [1, 2, 5, 17, MOST_PARTS])
def test_coinciding_parts_keep_the_image(parts):
    """Parts that are blended one after another: as opaque in the middle, and as much hidden along a line.

    The paper's double sum is the one pair of opacity and scale that does both.
    """
    logits, larger = divided(LOGITS, torch.full((len(LOGITS),), parts))
    assert logits.dtype == larger.dtype == torch.float64
    line = np.linspace(-12, 12, 20_001)
    for logit, part, log_factor in zip(LOGITS.double().tolist(), logits.tolist(), larger.tolist(), strict=True):
        one = np.exp(-0.5 * line**2) / (1 + math.exp(-logit))
        each = np.exp(-0.5 * (line / math.exp(log_factor)) ** 2) / (1 + math.exp(-part))
        seen = np.ones_like(line)
        for _ in range(parts):
            seen *= 1 - each
        assert 1 - seen[10_000] == pytest.approx(one[10_000], rel=1e-12)
        assert (1 - seen).sum() == pytest.approx(one.sum(), rel=1e-9)


def test_an_opacity_of_one_can_be_divided():
    logits, larger = divided(torch.tensor([40.0, 500.0, math.inf]), torch.tensor([2, 51, 51]))
    assert logits.isfinite().all() and larger.isfinite().all() and (larger < 0).all()


def test_draws_are_in_proportion_and_the_same_for_any_number_of_threads(threads):
    units, drawn = torch.tensor([0, 1, 5, 0, 2, 0]) * 2**30, []
    for count in (1, 3):
        threads(count)
        drawn.append(draw(units, 80_000, **DRAW)[1])
    assert torch.equal(*drawn)
    share = drawn[0].bincount(minlength=6) / 80_000
    assert (share[units == 0] == 0).all()
    # Five standard deviations of a share of one half are 0.009.
    torch.testing.assert_close(share, units / units.sum(), atol=0.009, rtol=0)
    for name in DRAW:
        assert not torch.equal(drawn[0], draw(units, 80_000, **DRAW | {name: DRAW[name] + 1})[1]), name


def _trained(count: int = 40, dead: int = 12) -> GaussianModel:
    """A model with averages of Adam, the last of whose Gaussians are dead."""
    gaussians = model(count, degree=1)
    take_steps(gaussians, 3)
    with torch.no_grad():
        gaussians._opacity.clamp_(-4.0, 4.0)
        gaussians._opacity[count - dead :] = -6.0
    for field in GROUPS.values():
        getattr(gaussians, field).grad = torch.ones_like(getattr(gaussians, field))
    return gaussians


def _values(gaussians: GaussianModel) -> dict[str, Tensor]:
    return {name: getattr(gaussians, field).detach().clone() for name, field in GROUPS.items()}


def _averages(gaussians: GaussianModel) -> list[Tensor]:
    state = [gaussians.optimizer.state[getattr(gaussians, field)] for field in GROUPS.values()]
    return [s[key].reshape(len(gaussians), -1).clone() for s in state for key in ("exp_avg", "exp_avg_sq")]


def _assert_parts(gaussians: GaussianModel, live: int, before: dict[str, Tensor], averages: list[Tensor]) -> None:
    """The first `live` Gaussians of `before` stayed, some of them as parts; all others are further parts of those."""
    after = _values(gaussians)
    (origins,) = (after["xyz"][live:, None] == before["xyz"][None, :live]).all(dim=2).nonzero()[:, 1:].T
    assert len(origins) == len(gaussians) - live  # each lies where a live one is
    copies = origins.bincount(minlength=live)
    alone = (copies == 0).nonzero()[:, 0]
    for name in GROUPS:
        assert torch.equal(after[name][live:], after[name][origins])
        stayed = alone if name in ("opacity", "scaling") else slice(live)
        assert torch.equal(after[name][stayed], before[name][stayed])
    logits, larger = divided(before["opacity"][:live, 0], copies + 1)
    torch.testing.assert_close(after["opacity"][:live, 0], logits.float())
    torch.testing.assert_close(after["scaling"][:live], before["scaling"][:live] + larger[:, None].float())
    for old, new in zip(averages, _averages(gaussians), strict=True):
        assert torch.equal(new[alone], old[alone]) and new[alone].any()
        assert not new[origins].any() and not new[live:].any()


def test_dead_gaussians_become_parts_of_live_ones():
    gaussians = _trained()
    before, averages = _values(gaussians), _averages(gaussians)
    assert relocate(gaussians, LEAST, **WHERE) == 12
    _assert_parts(gaussians, 28, before, averages)
    assert all(getattr(gaussians, field).grad is None for field in GROUPS.values())


@pytest.mark.parametrize("dead", [0, 40])
def test_without_dead_or_without_live_gaussians_nothing_changes(dead):
    gaussians = _trained(dead=dead)
    before, averages = _values(gaussians), _averages(gaussians)
    params = [getattr(gaussians, field) for field in GROUPS.values()]
    assert relocate(gaussians, LEAST, **WHERE) == dead
    assert all(torch.equal(value, before[name]) for name, value in _values(gaussians).items())
    assert all(torch.equal(old, new) for old, new in zip(averages, _averages(gaussians), strict=True))
    assert all(getattr(gaussians, f) is p and p.grad is not None for f, p in zip(GROUPS.values(), params, strict=True))


def test_growth_appends_parts():
    gaussians = _trained(dead=0)
    before, averages = _values(gaussians), _averages(gaussians)
    grow(gaussians, 7, **WHERE)
    assert len(gaussians) == 47
    _assert_parts(gaussians, 40, before, averages)
