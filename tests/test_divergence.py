"""NaN and infinities in a training: the step that is not taken, the model that is saved, and the message."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from diff_gaussian_rasterization.optim import adam_, sparse_adam_
from trainings import leaves

import train
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from scene.saved_model import read_model
from splatting import objective
from utils.system_utils import UserError

BETAS, EPS, RATE = (0.9, 0.999), 1e-15, 0.01
SMALL = ["-r", "24", "--test_iterations", "-1", "--no_curve"]
INF, NAN = float("inf"), float("nan")


# The operators

State = list[torch.Tensor]  # value, first moment, second moment


def _state(dtype: torch.dtype, rows: int = 100_000) -> tuple[State, torch.Tensor]:
    """Values (N, 3) that fill more than one block, and a gradient."""
    generator = torch.Generator().manual_seed(0)
    value, gradient = (torch.randn(rows, 3, generator=generator, dtype=dtype) for _ in range(2))
    return [value, 0.1 * gradient, gradient**2], gradient


def _dense(state: State, gradient: torch.Tensor, *guard: object) -> None:
    lists = [[t] for t in (state[0], gradient, *state[1:], torch.tensor(4.0))]
    adam_(*lists, [RATE], *BETAS, EPS, [2], *guard)


def _sparse(state: State, gradient: torch.Tensor, *guard: object) -> None:
    seen = torch.arange(len(gradient)) % 3 != 1
    sparse_adam_(state[0], gradient, *state[1:], seen, RATE, *BETAS, EPS, 2, *guard)


@pytest.fixture(params=[_dense, _sparse], ids=["adam", "sparse adam"])
def step(request) -> Callable[..., None]:
    return request.param


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_values_without_a_finite_step_are_marked_and_the_rest_goes_on(step, dtype):
    huge = 1e25 if dtype == torch.float32 else 1e200  # finite, but not its square
    stopped, loss = torch.zeros(1, dtype=torch.int64), torch.tensor(0.5, dtype=dtype)
    (plain, gradient), (guarded, _) = _state(dtype), _state(dtype)
    step(plain, gradient)
    step(guarded, gradient, loss, stopped, 1)
    assert all(torch.equal(a, b) for a, b in zip(plain, guarded, strict=True)) and stopped == 0

    bad = gradient.clone()
    poison = {(5, 0): NAN, (60_000, 1): INF, (99_999, 0): -INF, (3, 1): huge, (9, 2): NAN, (7, 0): NAN}
    for place, value in poison.items():
        bad[place] = value
    # Column 2 is inactive, and the sparse step does not see row 7.
    unseen = {(9, 2)} | ({(7, 0)} if step is _sparse else set())
    before = [t.clone() for t in guarded]
    step(guarded, bad, loss, stopped, 2)
    step(plain, gradient)
    assert stopped == 2
    marked = torch.zeros_like(guarded[1], dtype=torch.bool)
    for place in poison.keys() - unseen:
        marked[place] = True
    assert torch.equal(guarded[1].isnan(), marked)
    for part, (got, old, wanted) in enumerate(zip(guarded, before, plain, strict=True)):
        assert part == 1 or torch.equal(got[marked], old[marked])
        rest = ~(marked | (bad != gradient))
        assert torch.equal(got[rest], wanted[rest])

    last = [t.clone() for t in guarded]
    step(guarded, gradient, loss, stopped, 3)
    assert stopped == 2 and all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(guarded, last, strict=True))


# The training


def _train(scene: Path, out: Path, *more: object, iterations: int) -> Path:
    train.main(["-s", str(scene), "-m", str(out), "--iterations", str(iterations), *SMALL, *map(str, more)])
    return out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply"


def _nan_loss_in(monkeypatch: pytest.MonkeyPatch, iteration: int) -> None:
    plain, calls = objective.photometric_loss, []

    def broken(*args: object) -> tuple[torch.Tensor, torch.Tensor]:
        calls.append(1)
        loss, l1 = plain(*args)
        return (loss * NAN if len(calls) == iteration else loss), l1

    monkeypatch.setattr(objective, "photometric_loss", broken)


@pytest.mark.parametrize(
    ("broken", "optimizer"), [(3, "default"), (13, "sparse_adam"), (26, "default"), (12, "default")]
)
def test_the_model_before_a_loss_of_nan_is_saved(colmap_scene, tmp_path, monkeypatch, broken, optimizer):
    """Nothing moves after divergence, detected at once, on a save (3), on a change (13, 26), or later."""
    options = ["--densify_from_iter", 10, "--densification_interval", 13, "--densify_grad_threshold", 1e-4]
    options += ["--opacity_reset_interval", 26, "--optimizer_type", optimizer]
    monkeypatch.setattr("splatting.run.USUAL", 1)  # else bands follow the number of iterations
    _train(colmap_scene, tmp_path / "whole", *options, "--checkpoint_iterations", broken - 1, iterations=broken)
    _nan_loss_in(monkeypatch, broken)
    out = tmp_path / "broken"
    last = rf"is saved: resume with --start_checkpoint .*chkpnt{broken - 1}.pth and lower learning rates"
    with pytest.raises(UserError, match=rf"the loss of iteration {broken} \(view (left|Right)/.* not finite.*{last}"):
        _train(colmap_scene, out, *options, "--save_iterations", 3, "--checkpoint_iterations", 3, iterations=30)
    saved, wanted = (load_checkpoint(tmp_path / name / f"chkpnt{broken - 1}.pth") for name in ("broken", "whole"))
    # Statistics continue until the next check; the learning rates in the checkpoint are those of the next iteration.
    kept = [[*capture[:7], capture[10]["state"], capture[11]] for capture in (saved[0], wanted[0])]
    assert saved[1] == wanted[1] and leaves(kept[0]) == leaves(kept[1])
    plys = [path.name for path in out.glob("point_cloud/*")]
    assert sorted(plys) == sorted({"iteration_3", f"iteration_{broken - 1}"} if broken > 3 else {"iteration_2"})
    monkeypatch.undo()
    _train(colmap_scene, out, *options, "--start_checkpoint", out / f"chkpnt{broken - 1}.pth", iterations=30)


def test_a_first_loss_of_nan_leaves_nothing_to_save(colmap_scene, tmp_path, monkeypatch):
    _nan_loss_in(monkeypatch, 1)
    with pytest.raises(UserError, match="nothing was trained before; lower the learning rates"):
        _train(colmap_scene, tmp_path, iterations=5)
    assert not (tmp_path / "point_cloud").exists() and not list(tmp_path.glob("*.pth"))


def _poison(monkeypatch: pytest.MonkeyPatch, poison: Callable[[GaussianModel, torch.Tensor], None]) -> None:
    """Change the gradients, and the radii, of the fourth step."""
    plain, calls = GaussianModel.step, []

    def step(self: GaussianModel, radii: torch.Tensor) -> None:
        calls.append(1)
        if len(calls) == 4:
            poison(self, radii)
        plain(self, radii)

    monkeypatch.setattr(GaussianModel, "step", step)


@pytest.mark.parametrize("optimizer", ["default", "sparse_adam"])
def test_values_without_a_finite_step_stay_and_the_model_is_saved(colmap_scene, tmp_path, monkeypatch, optimizer):
    before = []

    def poison(gaussians: GaussianModel, radii: torch.Tensor) -> None:
        radii[[5, 17]] = 9  # the sparse optimiser must see them
        gaussians._xyz.grad[5, 1] = INF
        gaussians._opacity.grad[17] = NAN
        gaussians.exposures.values.grad[2, 0, 0] = NAN
        before.extend((gaussians._xyz[5, 1].item(), gaussians._opacity[17].item()))

    _poison(monkeypatch, poison)
    with pytest.raises(UserError, match=r"a step of iteration 4 \(view .* is not finite.*chkpnt4.pth"):
        words = "--optimizer_type", optimizer, "--plain_step", "--eval", "--train_test_exp"
        _train(colmap_scene, tmp_path, *words, iterations=30)
    capture, iteration = load_checkpoint(tmp_path / "chkpnt4.pth")
    assert iteration == 4 and [path.name for path in tmp_path.glob("point_cloud/*")] == ["iteration_4"]
    assert [capture[1][5, 1].item(), capture[6][17].item()] == before
    assert all(state["step"] == 4 for state in capture[10]["state"].values())
    averages = capture[10]["state"][0]["exp_avg"]
    assert averages[5, 1] == 0 and averages.isfinite().all()
    _train(colmap_scene, tmp_path, *words, "--start_checkpoint", tmp_path / "chkpnt4.pth", iterations=6)


def test_rates_that_overflow_leave_finite_values(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="a step of iteration 1 .* is not finite"):
        _train(colmap_scene, tmp_path, "--scaling_lr", "3e38", iterations=5)
    assert all(t.isfinite().all() for t in load_checkpoint(tmp_path / "chkpnt1.pth")[0][1:7])


def test_rates_a_hundred_times_too_high_end_in_a_warning(colmap_scene, tmp_path, capfd):
    rates = {"position_lr_init": 0.016, "position_lr_final": 0.016, "feature_lr": 0.25, "opacity_lr": 2.5}
    rates |= {"scaling_lr": 0.5, "rotation_lr": 0.1}
    high = [word for name, rate in rates.items() for word in (f"--{name}", rate)]
    options = ["--densify_from_iter", 50, "--densification_interval", 50, "--opacity_reset_interval", 300]
    ply = _train(colmap_scene, tmp_path, *options, *high, iterations=300)
    read_model(ply).check_finite(300)
    assert "so the model is worse than its start; lower the learning rates" in capfd.readouterr().err


def test_a_start_that_no_view_shows(blender_scene, tmp_path):
    (tmp_path / "far.txt").write_text("\n".join(f"{n} {n * n} {1e4 - n}" for n in range(50)))
    with pytest.raises(UserError, match="none of the 6 training views shows any Gaussian of the start; check the sc"):
        _train(blender_scene, tmp_path / "out", "--init_pcd_path", tmp_path / "far.txt", iterations=5)
    assert not (tmp_path / "out").exists()
