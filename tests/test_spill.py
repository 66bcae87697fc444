"""--spill: rows that step late, in the host's memory, give the bytes of rows that step in time."""

from pathlib import Path

import pytest
import torch
from diff_gaussian_rasterization.optim import adam_, catch_up_
from gaussians import cloud, model, needs_59_values, options
from trainings import OPTIONS, differences, leaves, narrow_scene, trained

from scene import spilled_model
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from splatting.training import memory_estimate, objective, run
from splatting.training.memory_estimate import spilled_bytes, training_bytes
from utils.system_utils import UserError

BETAS, EPS = (0.9, 0.999), 1e-15


@pytest.fixture(autouse=True)
def _awake(monkeypatch: pytest.MonkeyPatch) -> None:
    """No block sleeps beside the spilled model, which knows no sleep."""
    monkeypatch.setattr(run, "MOST_SHARE", 0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return narrow_scene(tmp_path_factory.mktemp("spill") / "scene")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("columns", [-1, 0, 9, 24])
def test_missed_steps_are_steps_without_a_gradient(threads, dtype, columns):
    count, past = 130, 90
    generator = torch.Generator().manual_seed(0)
    state = [torch.randn(count, 15, 3, generator=generator, dtype=dtype) for _ in range(3)]
    # Averages of all sizes, some of which fade to nothing.
    scale = 10 ** torch.linspace(-44, 5, count, dtype=torch.float64).reshape(-1, 1, 1).to(dtype)
    state[1], state[2] = state[1] * scale, (state[2] * scale) ** 2
    state[1][::5], state[2][::5] = 0, 0
    rates, numbers = [0.01 / (1 + k % 4) for k in range(past)], [float(40 + k) for k in range(past)]
    taken = (torch.arange(count, dtype=torch.int32) * 7) % (past + 1)
    wanted = [t.clone() for t in state]
    for k in range(past):
        rows = (taken <= k).nonzero().reshape(-1)
        part = [t[rows] for t in wanted]
        lists = [part[0]], [torch.zeros_like(part[0])], [part[1]], [part[2]], [torch.tensor(numbers[k] - 1)]
        adam_(*lists, [rates[k]], *BETAS, EPS, [columns])
        for whole, values in zip(wanted, part, strict=True):
            whole[rows] = values
    assert (state[0] == wanted[0]).all() == (columns == 0)
    for threads_now in (1, 3):
        found = [t.clone() for t in state]
        threads(threads_now)
        catch_up_(*found, taken, rates, numbers, *BETAS, EPS, columns)
        assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_what_does_not_fit_is_refused():
    state = [torch.ones(4, 3) for _ in range(3)]
    taken = torch.zeros(4, dtype=torch.int32)
    with pytest.raises(TypeError, match=r"taken must be torch.int32"):
        catch_up_(*state, taken.long(), [0.1], [1.0], *BETAS, EPS)
    with pytest.raises(ValueError, match=r"taken must be \(4,\)"):
        catch_up_(*state, taken[:3], [0.1], [1.0], *BETAS, EPS)
    with pytest.raises(ValueError, match="a rate for each of the 1 steps, got 2"):
        catch_up_(*state, taken, [0.1, 0.1], [1.0], *BETAS, EPS)
    assert all((t == 1).all() for t in state)


@pytest.mark.parametrize("most", [1, 4])
def test_a_long_list_of_missed_steps_is_cut(scene, tmp_path, monkeypatch, most):
    usual = trained(scene, tmp_path / "usual")
    monkeypatch.setattr(spilled_model, "_MOST_MISSED", most)
    assert differences(trained(scene, tmp_path / "spilled", "--spill"), usual) == []


def test_a_parameter_without_a_gradient_takes_no_step():
    gaussians = spilled_model.SpilledGaussians(1)
    gaussians.create_from_pcd(cloud(20), [], 1.0)
    gaussians.training_setup(options())
    gaussians.fetch(torch.arange(5)).get_xyz.sum().backward()
    gaussians.take_gradients()
    assert gaussians._xyz.grad.any(dim=1).sum() == 5
    gaussians.step(torch.ones(20, dtype=torch.int32))
    assert list(gaussians.optimizer.state) == [gaussians._xyz]


def _stopped(scene: Path, out: Path, *options: object) -> tuple[str, list[object]]:
    """What a run says that stops, and the state that it leaves, but for its statistics and learning rates."""
    with pytest.raises(UserError) as error:
        trained(scene, out, *options)
    (path,) = out.glob("chkpnt*.pth")
    capture, iteration = load_checkpoint(path)
    said = str(error.value).replace(str(out), "")
    return said, [iteration, *capture[:7], capture[10]["state"], capture[11]]


@pytest.mark.parametrize("kind", ["default", "sparse"])
@pytest.mark.parametrize("what", ["loss", "f_rest", "xyz"])
def test_a_guard_leaves_the_same_model_and_marks(scene, tmp_path, monkeypatch, what, kind):
    """From iteration 34 on, which is found out in 36, where the SH degree is raised."""
    results = []
    for name, further in (("usual", ("--plain_step",)), ("spilled", ("--spill",))):
        calls, loss, step = [], objective.photometric_loss, GaussianModel.step

        def broken(*args: object, calls=calls, loss=loss) -> tuple[torch.Tensor, torch.Tensor]:
            calls.append(1)
            total, l1 = loss(*args)
            return (total * float("nan") if what == "loss" and len(calls) == 34 else total), l1

        def poisoned(self: GaussianModel, radii: torch.Tensor, calls=calls, step=step) -> None:
            if what != "loss" and len(calls) == 34:
                row = int(radii.argmax())
                if what == "f_rest" and self.optimizer.parts:
                    part = self.optimizer.parts["f_rest"]
                    part.gradient[(part.rows == row).nonzero(), 1, 2] = float("inf")
                else:
                    self.raw(what).grad.view(len(self), -1)[row, 5 if what == "f_rest" else 1] = float("inf")
            step(self, radii)

        with monkeypatch.context() as patch:
            patch.setattr(objective, "photometric_loss", broken)
            patch.setattr(GaussianModel, "step", poisoned)
            results.append(_stopped(scene, tmp_path / name, *OPTIONS[kind], *further))
    (said, usual), (told, spilled) = results
    assert said == told and ("became nan" if what == "loss" else f"{what} of 1 of") in said
    assert leaves(spilled) == leaves(usual)


@needs_59_values
def test_the_estimate_leaves_out_what_lies_in_the_hosts_memory():
    gaussians = model(50)
    usual, spilled = (training_bytes(gaussians, 1000, 0, spill=spill) for spill in (None, True))
    assert usual == 1000 * (4 * (3 * 59 + 45) + memory_estimate.PER_GAUSSIAN)
    assert spilled_bytes(gaussians, 1000) == 1000 * 12 * 45
    seen = memory_estimate.SEEN * (45 * 32 + 14 * 8)
    assert spilled == 1000 * (16 * 14 + 4 + seen + memory_estimate.PER_GAUSSIAN)
