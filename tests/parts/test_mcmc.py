"""Training by --strategy mcmc: its parts, growth and its limit (tests/test_training_bytes.py: bytes and resuming)."""

from pathlib import Path

import pytest
import torch
from gaussians import model, options
from strategies import begun
from trainings import MCMC, train_on

from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from scene.saved_model import read_model
from splatting.parts.mcmc import rules
from splatting.parts.time_budget.paced import Block, Decided, DecidedSchedule
from utils.system_utils import UserError


def _train(scene: Path, out: Path, *options: object, iterations: int = 60) -> dict[int, bytes]:
    words = "-r", 48, "--iterations", iterations, "--no_curve", "--quiet", "--strategy", "mcmc", "--disable_viewer"
    window = "--densify_from_iter", 10, "--densification_interval", 10
    return train_on(scene, out, *words, *window, "--test_iterations", -1, *options)


@pytest.mark.parametrize("name", ["mcmc_noise", "mcmc_opacity_reg", "mcmc_scale_reg", "mcmc_init_scale"])
def test_every_part_has_an_effect(colmap_scene, tmp_path, name):
    one, other = (
        _train(colmap_scene, tmp_path / str(value), *MCMC[2:], f"--{name}", value, iterations=15)[15]
        for value in (0.001, 100)
    )
    assert one != other


def test_gaussians_are_moved(colmap_scene, tmp_path, monkeypatch):
    moved, relocate = [], rules.relocate
    monkeypatch.setattr(rules, "relocate", lambda *x, **named: moved.append(relocate(*x, **named)) or moved[-1])
    _train(colmap_scene, tmp_path, *MCMC[2:])
    assert len(moved) == 5 and moved[1] and any(moved[2:])


@pytest.mark.parametrize(("growth", "count", "grown"), [(0.05, 5, 6), (0.05, 40, 42), (0.0, 5, 5), (1.0, 30, 45)])
def test_a_few_gaussians_grow_at_least_by_one(growth, count, grown):
    control = begun("mcmc", opt=options(max_num_splats=45, mcmc_growth=growth))
    assert control.projected_count(count, 600, 601) == grown


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


def test_a_scene_that_fades_is_refused(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="above 0.9 in iteration 20: .*lower --mcmc_opacity_reg"):
        _train(colmap_scene, tmp_path, "--mcmc_min_opacity", 0.9)
