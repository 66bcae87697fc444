"""Training by --strategy mcmc: the same bytes by every way to take a step, resuming, growth and its limit."""

import argparse
from pathlib import Path

import pytest
import torch
from gaussians import model
from rasterizer_tools import GPU_MARKS
from trainings import OPTIONS, differences, trained

import train
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from splatting.training.density import DensityControl
from splatting.training.schedule import Block, Decided, DecidedSchedule
from splatting.training.steps import captured, speculative
from splatting.training.strategies.mcmc import MarkovChain
from utils.system_utils import UserError

# Within so few iterations no Gaussian fades, so the thresholds are at the opacities of the start.
ACTIVE = ("--mcmc_noise", 5e4, "--mcmc_gate_opacity", 0.5, "--mcmc_min_opacity", 0.45)


@pytest.fixture
def scene(colmap_scene: Path) -> Path:
    return colmap_scene


def _train(source: Path, out: Path, *options: object, iterations: int = 60) -> Path:
    words = ["-s", source, "-m", out, "-r", 48, "--iterations", iterations, "--no_curve", "--quiet"]
    words += ["--strategy", "mcmc", "--disable_viewer"]
    words += ["--densify_from_iter", 10, "--densification_interval", 10, "--test_iterations", -1, *options]
    train.main(list(map(str, words)))
    return out


def _raw(out: Path, iteration: int) -> GaussianModel:
    gaussians = GaussianModel(3)
    gaussians.load_ply(out / f"point_cloud/iteration_{iteration}/point_cloud.ply")
    return gaussians


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
@pytest.mark.parametrize("options", [(), OPTIONS["sparse"]], ids=["default", "sparse"])
def test_a_step_that_halts_is_moved_once(scene, tmp_path, monkeypatch, options, _):
    """With room for what the last visit of a view needed, and no more, many steps halt and are repeated."""
    options = ("--strategy", "mcmc", *ACTIVE, *options)
    plain = trained(scene, tmp_path / "plain", "--plain_step", *options)
    halts, repeat = [], speculative.Speculation._replay
    monkeypatch.setattr(speculative.Speculation, "_replay", lambda *x: (halts.append(1), repeat(*x)))
    monkeypatch.setattr(speculative, "_with_spare", lambda count: count)
    for name, least in (("_INSTANCES", 0), ("_SLOTS", 0), ("_LEAST", 1)):
        monkeypatch.setattr(captured, name, least)
    assert differences(trained(scene, tmp_path / "halting", *options), plain) == []
    assert len(halts) > 5


@pytest.mark.parametrize("name", ["mcmc_noise", "mcmc_opacity_reg", "mcmc_scale_reg", "mcmc_init_scale"])
def test_every_part_has_an_effect(scene, tmp_path, name):
    one, other = (
        _train(scene, tmp_path / str(value), *ACTIVE, f"--{name}", value, iterations=15) for value in (0.001, 100)
    )
    assert not torch.equal(_raw(one, 15)._xyz, _raw(other, 15)._xyz)


def test_resumed_training_gives_the_same_bytes(scene, tmp_path, monkeypatch):
    relocated, relocate = [], GaussianModel.relocate

    def noted(self, *x, **named):
        relocated.append(relocate(self, *x, **named))
        return relocated[-1]

    monkeypatch.setattr(GaussianModel, "relocate", noted)
    options = *ACTIVE, "--checkpoint_iterations", 35
    whole = _train(scene, tmp_path / "a", *options)
    assert len(relocated) == 5 and relocated[1] and relocated[-1]
    resumed = _train(scene, tmp_path / "b", *options, "--start_checkpoint", whole / "chkpnt35.pth")
    last = "point_cloud/iteration_60/point_cloud.ply"
    assert (whole / last).read_bytes() == (resumed / last).read_bytes()
    other = _train(scene, tmp_path / "c", *options, "--seed", 6)
    assert (whole / last).read_bytes() != (other / last).read_bytes()


def test_growth_ends_at_the_limit(scene, tmp_path):
    every = [str(t) for t in range(5, 60, 10)]
    counts = []
    for limit, out in ((0, "free"), (430, "limited"), (3, "full")):
        run = _train(
            scene, tmp_path / out, "--max_num_splats", limit, "--mcmc_growth", 0.3, "--mcmc_until_iter", 50,
            "--checkpoint_iterations", *every,
        )  # fmt: skip
        counts.append([len(load_checkpoint(run / f"chkpnt{t}.pth")[0][1]) for t in every])
    start = counts[0][0]
    grown = [start, start]  # 10 is not above --densify_from_iter, 50 is not below --mcmc_until_iter
    for _ in range(3):
        grown.append(int(1.3 * grown[-1]))
    assert counts[0] == [*grown, grown[-1]]
    assert counts[1] == [min(count, 430) for count in counts[0]] and counts[1][-1] == 430
    assert counts[2] == [start] * 6  # nothing is removed


@pytest.mark.parametrize("stride", [1.0, 10.0])
def test_a_start_larger_than_the_clock_can_train_loses_the_faintest(stride):
    """25 Gaussians for each iteration; without a clock, or with enough of it, nothing is removed."""
    gaussians = model(200)
    with torch.no_grad():
        gaussians._opacity[:, 0] = torch.linspace(2.0, -2.0, 200)
    opt = argparse.Namespace(
        mcmc_opacity_reg=0, mcmc_scale_reg=0, mcmc_until_iter=0, max_num_splats=0,
        mcmc_min_opacity=0.005, mcmc_parts=51, seed=0,
    )  # fmt: skip
    control, kept = MarkovChain(gaussians, opt), gaussians._xyz.detach().clone()
    control.schedule = DecidedSchedule(Decided(60, [Block(30, 0.0, stride / 60, 0.0)], None, 9.0))
    control._relocate(1)
    left = 200 if stride == 1.0 else 25 * 6
    assert len(gaussians) == left and torch.equal(gaussians._xyz, kept[:left])


@pytest.mark.parametrize(("growth", "count", "grown"), [(0.05, 5, 6), (0.05, 40, 42), (0.0, 5, 5), (1.0, 30, 45)])
def test_a_few_gaussians_grow_at_least_by_one(growth, count, grown):
    counts = [count]

    class Few:
        gaussian_count = property(lambda _: counts[-1])

        def grow(self, new, *_, **__) -> None:
            counts.append(counts[-1] + new)

    options = dict.fromkeys(("mcmc_opacity_reg", "mcmc_scale_reg", "mcmc_parts", "mcmc_until_iter", "seed"), 0)
    MarkovChain(Few(), argparse.Namespace(max_num_splats=45, mcmc_growth=growth, **options))._grow(1)
    assert counts[-1] == grown


def test_the_start_is_more_opaque_and_smaller_than_the_points(scene, tmp_path):
    once = "--save_iterations", 1
    mcmc, adc = (
        _raw(_train(scene, tmp_path / name, *once, "--strategy", name, iterations=2), 1) for name in ("mcmc", "adc")
    )
    torch.testing.assert_close(mcmc.get_opacity, torch.full_like(mcmc._opacity, 0.5))
    torch.testing.assert_close(mcmc.get_scaling, 0.1 * adc.get_scaling)
    ply = tmp_path / "adc/point_cloud/iteration_1/point_cloud.ply"
    given = _raw(_train(scene, tmp_path / "given", *once, "--init_ply", ply, iterations=2), 1)
    torch.testing.assert_close(given.get_scaling, adc.get_scaling)  # a model brings its own shapes


def test_a_scene_that_fades_is_refused(scene, tmp_path):
    with pytest.raises(UserError, match="above 0.9 in iteration 20: .*lower --mcmc_opacity_reg"):
        _train(scene, tmp_path, "--mcmc_min_opacity", 0.9)


def test_other_strategies_have_no_penalty():
    assert not any(DensityControl.penalty) and not DensityControl.queues
