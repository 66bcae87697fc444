"""--views_per_step: late iterations share a step of the optimisers, on which way and in however many parts they run."""

import json
import sys
from pathlib import Path

import pytest
import torch
from gaussians import model, options
from rasterizer_tools import GPU_MARKS
from test_divergence import _nan_loss_in
from test_steps import OPTIONS, differences, fused_iterations, trained
from test_steps import scene as scene  # a fixture

import train
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from training.density import DensityControl
from training.late_steps import LateSteps
from training.observers import memory
from training.pacing.pace import Block, Paced, Schedule
from utils.system_utils import UserError

LATE = ("--densify_until_iter", 30, "--views_per_step", 4)
PLY = "point_cloud/iteration_60/point_cloud.ply"


@pytest.fixture(autouse=True)
def _stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it


def _train(scene: Path, out: Path, *more: object, iterations: int = 60) -> Path:
    words = ["-s", scene, "-m", out, "-r", 48, "--iterations", iterations, "--disable_viewer", "--no_curve", "--quiet"]
    words += ["--densify_from_iter", 10, "--densification_interval", 10, "--test_iterations", -1, *LATE, *more]
    train.main(list(map(str, words)))
    return out


def _late(views: int, ends: float, changes: int = -1) -> LateSteps:
    density = DensityControl()
    density.ends = ends
    return LateSteps(views, density, lambda iteration: iteration == changes)


def test_steps_are_those_of_every_nth_iteration_after_density_control():
    late = _late(4, 30)
    assert [t for t in range(1, 45) if not late.waits(t)] == [*range(1, 30), 32, 36, 40, 44]
    assert [t for t in range(25, 45) if late.shares(t)] == [*range(30, 45)]
    assert [late.whole(t) for t in (29, 30, 31, 32, 35, 36)] == [29, 29, 29, 32, 32, 36]
    assert late.steps(range(30, 45)) == 4
    assert [t for t in range(30, 41) if not _late(4, 30, changes=34).waits(t)] == [32, 34, 36, 40]
    assert not any(map(_late(1, 0).shares, range(9))) and not any(map(_late(4, DensityControl.ends).shares, range(99)))
    paced = _late(2, 50)
    paced._density.pace = Paced(Schedule(100, [Block(20, 0.0, 0.05, 0.0)], 20, 0.0))  # 5 of the schedule at a time
    assert [t for t in range(1, 20) if paced.waits(t)] == [11, 13, 15, 17, 19]


@pytest.mark.parametrize(("strategy", "end"), [("adc", 30), ("budget", 30), ("mcmc", 35)])
def test_density_control_has_ended_by_then(scene, tmp_path, monkeypatch, strategy, end):
    seen, take = [], GaussianModel.hold
    monkeypatch.setattr(GaussianModel, "hold", lambda self, radii: (seen.append(len(self)), take(self, radii)))
    out = _train(
        scene, tmp_path, "--strategy", strategy, "--mcmc_until_iter", 35, "--max_num_splats", 400,
        "--checkpoint_iterations", end - 1,
    )  # fmt: skip
    state = load_checkpoint(out / f"chkpnt{end - 1}.pth")[0]
    assert {*seen} == {len(state[1])} and len(seen) == sum(t % 4 > 0 for t in range(end, 60))
    assert "held" not in state[10]


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_every_way_to_take_steps_gives_the_same_bytes(scene, tmp_path, monkeypatch, options):
    plain = trained(scene, tmp_path / "plain", "--plain_step", *LATE, *options)
    fused = fused_iterations(monkeypatch)
    assert differences(trained(scene, tmp_path / "fused", *LATE, *options), plain) == []
    assert sorted({*fused}) == [t for t in range(1, 30) if t != 20]
    assert trained(scene, tmp_path / "off", *LATE, *options, "--views_per_step", 1)["ply"] != plain["ply"]


def test_the_gradients_of_a_step_are_the_sum_of_its_views(scene, tmp_path, monkeypatch):
    """The state before the first step that is shared, and the gradients that each of its views has there, alone."""
    summed, alone, step = {}, [], GaussianModel.step

    def noted(self: GaussianModel, radii: torch.Tensor) -> None:
        if self.optimizer_steps == 28:
            summed.update({name: self.raw(name).grad.clone() for name in ("xyz", "opacity", "f_dc")})
        step(self, radii)

    def single(self: GaussianModel, radii: torch.Tensor) -> None:
        if self.optimizer_steps >= 28:
            alone.append({name: self.raw(name).grad.clone() for name in ("xyz", "opacity", "f_dc")})
            self.drop_gradients()  # the model stays
        else:
            step(self, radii)

    monkeypatch.setattr(GaussianModel, "step", noted)
    _train(scene, tmp_path / "a", iterations=33)
    monkeypatch.setattr(GaussianModel, "step", single)
    _train(scene, tmp_path / "b", "--views_per_step", 1, "--plain_step", iterations=33)
    assert len(summed) == 3 and len(alone) >= 3
    for name, total in summed.items():
        assert torch.equal(total, alone[0][name] + alone[1][name] + alone[2][name]) and total.any()


@pytest.mark.parametrize(
    "options",
    [
        ("--random_background",),
        ("--optimizer_type", "sparse_adam"),
        ("--eval", "--train_test_exp"),
        ("--strategy", "mcmc", "--mcmc_until_iter", 30, "--mcmc_min_opacity", 0.45),
        ("--strategy", "budget", "--max_num_splats", 400),
        ("--sh_degree", 0, "--densify_until_iter", 0),
    ],
    ids=["adc", "sparse", "exposure", "mcmc", "budget", "from the start"],
)
def test_a_training_resumed_within_a_step_gives_the_same_bytes(scene, tmp_path, options):
    whole = _train(scene, tmp_path / "whole", *options, "--checkpoint_iterations", 34, 36, 58)
    states = {t: load_checkpoint(whole / f"chkpnt{t}.pth")[0][10] for t in (34, 36, 58)}
    assert ["held" in states[t] for t in states] == [True, False, True]
    for t in states:
        more = "--checkpoint_iterations", 58, "--start_checkpoint", whole / f"chkpnt{t}.pth"
        resumed = _train(scene, tmp_path / str(t), *options, *more)
        assert (resumed / PLY).read_bytes() == (whole / PLY).read_bytes()
    anew = load_checkpoint(tmp_path / "34" / "chkpnt58.pth")[0][10]["held"]
    assert torch.equal(anew["seen"], states[58]["held"]["seen"])
    assert all(torch.equal(anew["gradients"][name], values) for name, values in states[58]["held"]["gradients"].items())


def test_the_sparse_optimiser_steps_what_any_of_the_views_saw():
    gaussians = model(4, optimizer_type="sparse_adam")
    gaussians.training_setup(options())
    before = gaussians._xyz.detach().clone()
    gaussians._xyz.grad = torch.ones_like(before)
    for row in (0, 2):
        gaussians.hold(torch.eye(4, dtype=torch.int32)[row])
    gaussians.step(torch.tensor([0, 1, 0, 0]))
    assert (gaussians._xyz != before).any(dim=1).tolist() == [True, True, True, False]
    gaussians._xyz.grad = torch.ones_like(before)
    after = gaussians._xyz.detach().clone()
    gaussians.step(torch.tensor([0, 0, 0, 1]))
    assert (gaussians._xyz != after).any(dim=1).tolist() == [False, False, False, True]


def test_gradients_that_were_not_held_would_be_missed(scene, tmp_path):
    whole = _train(scene, tmp_path / "whole", "--checkpoint_iterations", 34)
    capture, iteration = load_checkpoint(whole / "chkpnt34.pth")
    del capture[10]["held"]
    torch.save((capture, iteration), tmp_path / "chkpnt34.pth")
    resumed = _train(scene, tmp_path / "resumed", "--start_checkpoint", tmp_path / "chkpnt34.pth")
    assert (resumed / PLY).read_bytes() != (whole / PLY).read_bytes()


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (lambda held: held.pop("seen"), "its held gradients are incomplete"),
        (lambda held: held.update(seen=held["seen"][1:]), "of another number of Gaussians"),
        (lambda held: held.update(seen=held["seen"].float()), "of another number of Gaussians"),
        (lambda held: held["gradients"].update(xyz=torch.zeros(3)), "the held gradient of xyz does not fit"),
        (lambda held: held["gradients"].update(hue=torch.zeros(3)), "the held gradient of hue does not fit"),
        (lambda held: held["gradients"]["opacity"].fill_(torch.nan), "gradient of opacity does not fit, or is not fin"),
        (lambda held: held.update(gradients=3), "its held gradients are incomplete"),
    ],
)
def test_held_gradients_that_do_not_fit_are_refused(scene, tmp_path, broken, reason):
    whole = _train(scene, tmp_path / "whole", "--checkpoint_iterations", 31, iterations=33)
    capture, iteration = load_checkpoint(whole / "chkpnt31.pth")
    broken(capture[10]["held"])
    torch.save((capture, iteration), tmp_path / "chkpnt31.pth")
    with pytest.raises(UserError, match=reason):
        _train(scene, tmp_path / "resumed", "--start_checkpoint", tmp_path / "chkpnt31.pth")


@pytest.mark.parametrize("broken", [29, 30, 34, 36, 37])
def test_a_loss_of_nan_goes_back_to_the_last_step(scene, tmp_path, monkeypatch, broken):
    """To the model after it, from which a resumed training gives the bytes of one that never failed."""
    whole = _train(scene, tmp_path / "whole")
    good = _late(4, 30).whole(broken - 1)
    _nan_loss_in(monkeypatch, broken)
    with pytest.raises(UserError, match=rf"nan in iteration {broken} .*after iteration {good}, is saved"):
        _train(scene, tmp_path / "broken", "--checkpoint_iterations", 45)
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    checkpoint = tmp_path / "broken" / f"chkpnt{good}.pth"
    state = load_checkpoint(checkpoint)[0][10]
    steps = _late(4, 30).steps(range(1, good + 1)) - 1  # the densification of iteration 20 has dropped its gradients
    assert "held" not in state and state["state"][0]["step"] == steps
    resumed = _train(scene, tmp_path / "resumed", "--start_checkpoint", checkpoint)
    assert (resumed / PLY).read_bytes() == (whole / PLY).read_bytes()


def test_a_training_without_memory_goes_back_to_the_last_step(scene, tmp_path, monkeypatch):
    whole = _train(scene, tmp_path / "whole")
    reached, begins = [], memory.MemoryGuard.begins

    def full(self, step):
        begins(self, step)
        reached.append(step.iteration)
        if step.iteration == 43:
            raise MemoryError

    monkeypatch.setattr(memory.MemoryGuard, "begins", full)
    with pytest.raises(UserError, match="ran out of memory in iteration 43 .* the model after iteration 40 is saved"):
        _train(scene, tmp_path / "full")
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    resumed = _train(scene, tmp_path / "resumed", "--start_checkpoint", tmp_path / "full" / "chkpnt40.pth")
    assert (resumed / PLY).read_bytes() == (whole / PLY).read_bytes()


def test_the_log_counts_the_steps(scene, tmp_path):
    more = "--save_iterations", 20, 40, "--checkpoint_iterations", 50
    out = _train(scene, tmp_path / "a", *more)
    logged = {r["iteration"]: r.get("optimizer_steps") for r in json.loads((out / "train_log.json").read_text())}
    # A score or a save of an iteration is of the model before its step; a checkpoint has the step.
    assert logged == {20: None, 40: 28 + 2, 50: 28 + 5, 60: 28 + 7}  # none in iteration 20, which densifies
    on = _train(scene, tmp_path / "b", "--views_per_step", 1, "--start_checkpoint", out / "chkpnt50.pth")
    assert json.loads((on / "train_log.json").read_text())[-1]["optimizer_steps"] == 28 + 5 + 9
    off = _train(scene, tmp_path / "c", *more, "--views_per_step", 1)
    assert not any("optimizer_steps" in record for record in json.loads((off / "train_log.json").read_text()))


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_the_gpu_gives_the_same_bytes_twice(scene, tmp_path, _):
    one, other = (trained(scene, tmp_path / name, *LATE) for name in ("a", "b"))
    assert differences(one, other) == []
