"""The ways to take a step of training: the fast ones give the bytes of the plain one."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rasterizer_tools import GPU_MARKS

import train
from scene import lazy_rows
from scene.lazy_rows import LazyRows
from scene.readers.point_cloud import write_point_cloud
from training import run
from training.objective import Objective
from training.steps import ahead, run_ahead
from training.steps.ahead import AheadStep
from training.steps.choose import step_taker
from training.steps.fused import FusedStep
from training.steps.plain import PlainStep

ITERATIONS = 60
DENSITY = ("--densify_from_iter", 10, "--densification_interval", 20, "--opacity_reset_interval", 30)
OPTIONS = {
    "default": (),
    "sparse": ("--optimizer_type", "sparse_adam", "--random_background"),
    "exposure": ("--train_test_exp", "--antialiasing"),
    "depth": ("-d", "depths", "--depth_l1_weight_init", 1.0),
    "masks": ("--masks", "masks"),
    "degree 0": ("--sh_degree", 0),
}


@pytest.fixture(autouse=True)
def _stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it


@pytest.fixture
def scene(colmap_scene: Path) -> Path:
    """The COLMAP scene with a mask and an inverse depth map for each photo."""
    images = colmap_scene / "images"
    photos = [photo.relative_to(images) for photo in images.rglob("*") if photo.is_file()]
    mask = np.full((64, 96), 255, np.uint8)
    mask[:, :20] = 0
    depth = np.linspace(0, 2**15, 64 * 96).astype(np.uint16).reshape(64, 96)
    for photo in photos:
        for pixels, path in ((mask, f"masks/{photo}.png"), (depth, f"depths/{photo.with_suffix('.png')}")):
            (colmap_scene / path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(colmap_scene / path)
    scales = {str(photo.with_suffix("")): {"scale": 1.0, "offset": 0.0} for photo in photos}
    (colmap_scene / "sparse/0/depth_params.json").write_text(json.dumps(scales))
    return colmap_scene


@pytest.fixture
def lazy(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows wait in every step that lets them, and all of them catch up often. Gets the rows that lack some, by step."""
    lacking, arguments = [], LazyRows.arguments

    def noted(self: LazyRows) -> dict:
        lacking.append(int(((self._last >= 0) & (self._last < self._taken)).sum()))
        return arguments(self)

    monkeypatch.setattr(LazyRows, "_pays", lambda self: True)
    monkeypatch.setattr(lazy_rows, "_SPAN", 7)
    monkeypatch.setattr(LazyRows, "arguments", noted)
    return lacking


@pytest.fixture
def wide_scene(scene: Path) -> Path:
    """The scene with points all around, of which each view sees a part."""
    random = np.random.default_rng(0)
    write_point_cloud(scene / "sparse/0/points3D.ply", random.uniform(-4, 4, (600, 3)), random.random((600, 3)))
    return scene


def trained(scene: Path, out: Path, *options: object) -> dict[str, bytes | list]:
    """Train; the bytes of the PLY, and the tensors and numbers of the checkpoint."""
    words = ["-s", scene, "-m", out, "--eval", "-r", 48, "--iterations", ITERATIONS, *DENSITY, "--no_curve", "--quiet"]
    train.main(list(map(str, [*words, "--test_iterations", -1, "--checkpoint_iterations", ITERATIONS, *options])))
    leaves = []

    def collect(value: object) -> None:
        if torch.is_tensor(value):
            leaves.append((value.shape, value.detach().cpu().numpy().tobytes()))
        elif isinstance(value, dict):
            for key, item in value.items():
                leaves.append(key)
                collect(item)
        elif isinstance(value, list | tuple):
            for item in value:
                collect(item)
        else:
            leaves.append(value)

    collect(torch.load(out / f"chkpnt{ITERATIONS}.pth", weights_only=False))
    return {"ply": (out / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply").read_bytes(), "checkpoint": leaves}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_the_fused_step_gives_the_bytes_of_the_plain_one(scene, tmp_path, monkeypatch, options):
    plain = trained(scene, tmp_path / "plain", "--plain_step", *options)
    fused, advance = [], FusedStep.advance
    monkeypatch.setattr(FusedStep, "advance", lambda self, at, *x: (fused.append(at.iteration), advance(self, at, *x)))
    assert trained(scene, tmp_path / "fused", *options) == plain
    # Densification, the resets of opacities and the last iteration change rows, or take no step.
    assert fused == [t for t in range(1, ITERATIONS) if t not in (20, 30, 40)]


def test_losses_that_are_kept_keep_no_image(scene, tmp_path, monkeypatch):
    """Observers note them until something is due; a graph would keep the image and its gradient that long."""
    measure, told = FusedStep.measure, []

    def noted(self, step):
        measured = measure(self, step)
        told.extend(value for value in measured[1] if value is not None)
        return measured

    monkeypatch.setattr(FusedStep, "measure", noted)
    trained(scene, tmp_path / "a", *OPTIONS["depth"])
    assert len(told) > 100 and not any(value.requires_grad for value in told)


def test_what_may_want_gradients_takes_the_plain_step(scene, tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr("training.loop.step_taker", lambda run: (taken.append(step_taker(run)), taken[-1])[1])

    class WithFurtherTerm(Objective):
        pass

    trained(scene, tmp_path / "a")
    trained(scene, tmp_path / "b", "--detect_anomaly")
    torch.autograd.set_detect_anomaly(False)
    monkeypatch.setattr(run, "Objective", WithFurtherTerm)
    trained(scene, tmp_path / "c")
    fast = AheadStep if torch.cuda.is_available() else FusedStep
    assert [type(one) for one in taken] == [fast, PlainStep, PlainStep]


def test_a_term_that_was_added_to_our_objective_is_not_lost(scene, tmp_path, monkeypatch):
    """Its gradients go past the image, so the steps from there on are plain."""
    call, fused, advance = Objective.__call__, [], FusedStep.advance
    models = []

    def with_term(self, package, step):
        losses = call(self, package, step)
        return losses if step.iteration < 15 else losses._replace(total=losses.total + models[-1]._scaling.exp().mean())

    make = run.GaussianModel
    monkeypatch.setattr(run, "GaussianModel", lambda *x: (models.append(make(*x)), models[-1])[1])
    plain = trained(scene, tmp_path / "without")
    monkeypatch.setattr(Objective, "__call__", with_term)
    wanted = trained(scene, tmp_path / "plain", "--plain_step")
    monkeypatch.setattr(FusedStep, "advance", lambda self, at, *x: (fused.append(at.iteration), advance(self, at, *x)))
    assert trained(scene, tmp_path / "fused") == wanted != plain
    assert fused == list(range(1, 15))


class Immediate:
    """Stands for RunAhead where there is no GPU: every step is done at once."""

    def __init__(self, *_: object) -> None:
        self.settle = lambda: None
        self.give_up = lambda: 0

    def take(self, view: int, step, repeat) -> None:
        step()


@pytest.mark.parametrize("term", [False, True], ids=["ours", "with a further term"])
def test_steps_that_are_queued_give_the_same_bytes(scene, tmp_path, monkeypatch, term):
    call, models, make = Objective.__call__, [], run.GaussianModel

    def with_term(self, package, step):
        losses = call(self, package, step)
        return losses._replace(total=losses.total + models[-1]._scaling.exp().mean()) if step.iteration > 14 else losses

    monkeypatch.setattr(run, "GaussianModel", lambda *x: (models.append(make(*x)), models[-1])[1])
    if term:
        monkeypatch.setattr(Objective, "__call__", with_term)
    plain = trained(scene, tmp_path / "plain", "--plain_step")
    monkeypatch.setattr(ahead, "RunAhead", Immediate)
    monkeypatch.setattr("training.loop.step_taker", AheadStep)
    queued, queue = [], AheadStep._queue
    monkeypatch.setattr(AheadStep, "_queue", lambda self, step: (queued.append(step.iteration), queue(self, step))[1])
    assert trained(scene, tmp_path / "ahead", *OPTIONS["default"]) == plain
    assert len(queued) > (10 if term else 40)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_rows_that_wait_give_the_same_bytes(wide_scene, tmp_path, monkeypatch, lazy, options):
    monkeypatch.setattr(run, "SH_INTERVAL", 12)
    options = (*options, "--save_iterations", 25)
    plain = trained(wide_scene, tmp_path / "plain", "--plain_step", *options)
    assert trained(wide_scene, tmp_path / "lazy", *options) == plain
    saved = [tmp_path / name / "point_cloud/iteration_25/point_cloud.ply" for name in ("plain", "lazy")]
    assert saved[0].read_bytes() == saved[1].read_bytes()
    if "sparse_adam" in options:
        assert not lazy
    else:
        assert len(lazy) > 40 and sum(count > 0 for count in lazy) > 20


def test_rows_settle_when_the_rates_change_to_what_they_cannot_wait_with(wide_scene, tmp_path, monkeypatch, lazy):
    """Late steps are right for rates from 0 to 1 only. Other rates that change on the way belong to their steps."""
    prepare = run.Run.prepare

    def changing(self: run.Run, step) -> None:
        prepare(self, step)
        for group in self.gaussians.optimizer.param_groups:
            if group["name"] in ("f_dc", "f_rest"):
                group["lr"] = -1e-5 if 12 <= step.iteration < 18 else 1e-3 / (1 + step.iteration % 3)

    monkeypatch.setattr(run.Run, "prepare", changing)
    plain = trained(wide_scene, tmp_path / "plain", "--plain_step")
    assert trained(wide_scene, tmp_path / "lazy") == plain
    assert 30 < len(lazy) < 50


class Halting:
    """Stands for RunAhead where there is no GPU: groups of steps change nothing, and are then repeated."""

    models: list[LazyRows]

    def __init__(self, _device: torch.device, _first: tuple, rewind) -> None:
        self._rewind, self._gaussians, self._pending, self.repeated = rewind, rewind.__self__, [], 0

    def _tensors(self) -> list[torch.Tensor]:
        gaussians = self._gaussians
        values = [gaussians.raw(name) for name in gaussians._attributes]
        states = [gaussians.optimizer.state_of(value)[key] for value in values for key in ("exp_avg", "exp_avg_sq")]
        lazy = [[rows._last, rows._ring, rows._taken] for rows in self.models if rows.active]
        statistics = gaussians.max_radii2D, gaussians.xyz_gradient_accum, gaussians.denom
        return [t.detach() for t in (*values, *states, *statistics, *sum(lazy, []))]

    def take(self, view: int, step, repeat) -> None:
        before = [(tensor, tensor.clone()) for tensor in self._tensors()]
        step()
        for tensor, old in before:
            tensor.copy_(old)
        self._pending.append(repeat)
        if len(self._pending) == 4:
            self.settle()

    def settle(self) -> None:
        pending, self._pending = self._pending, []
        self._rewind(len(pending))
        for repeat in pending:
            repeat()

    def give_up(self) -> int:
        return 0


@pytest.mark.parametrize("term", [False, True], ids=["ours", "with a further term"])
def test_rows_wait_through_halts(wide_scene, tmp_path, monkeypatch, lazy, term):
    call, models, make = Objective.__call__, [], run.GaussianModel

    def with_term(self, package, step):
        losses = call(self, package, step)
        further = models[-1]._features_rest.square().mean()
        return losses._replace(total=losses.total + further) if step.iteration > 34 else losses

    monkeypatch.setattr(run, "GaussianModel", lambda *x: (models.append(make(*x)), models[-1])[1])
    monkeypatch.setattr(run, "SH_INTERVAL", 12)
    if term:
        monkeypatch.setattr(Objective, "__call__", with_term)
    plain = trained(wide_scene, tmp_path / "plain", "--plain_step")
    rows, start = [], LazyRows.__init__
    monkeypatch.setattr(LazyRows, "__init__", lambda self, model: (rows.append(self), start(self, model))[1])
    monkeypatch.setattr(Halting, "models", rows, raising=False)
    monkeypatch.setattr(ahead, "RunAhead", Halting)
    monkeypatch.setattr("training.loop.step_taker", AheadStep)
    assert trained(wide_scene, tmp_path / "ahead") == plain
    assert len(lazy) > (50 if term else 80)  # each once more when it is repeated


def test_a_training_that_fails_leaves_no_row_behind(wide_scene, tmp_path, monkeypatch, lazy):
    """The model is that of the step before the one that failed."""
    models, make, advance = [], run.GaussianModel, FusedStep.advance
    monkeypatch.setattr(run, "GaussianModel", lambda *x: (models.append(make(*x)), models[-1])[1])

    def failing(self: FusedStep, at, *rest) -> None:
        if at.iteration == 28:
            raise ZeroDivisionError
        advance(self, at, *rest)

    monkeypatch.setattr(FusedStep, "advance", failing)
    values = []
    for name, pays in (("dense", False), ("lazy", True)):
        monkeypatch.setattr(LazyRows, "_pays", lambda self, pays=pays: pays)
        with pytest.raises(ZeroDivisionError):
            trained(wide_scene, tmp_path / name)
        assert bool(lazy) == pays
        states = [models[-1].optimizer.state[models[-1].raw(name)] for name in ("f_dc", "f_rest")]
        averages = [state[key] for state in states for key in ("exp_avg", "exp_avg_sq")]
        values.append([models[-1].raw("f_dc"), models[-1].raw("f_rest"), *averages])
    for one, other in zip(*values, strict=True):
        assert one.detach().cpu().numpy().tobytes() == other.detach().cpu().numpy().tobytes()


@pytest.mark.parametrize("pipe", ["--compute_cov3D_python", "--convert_SHs_python", "--debug"])
def test_options_that_the_operator_does_not_know_take_the_plain_step(scene, tmp_path, monkeypatch, pipe):
    monkeypatch.setattr(FusedStep, "advance", lambda *_: pytest.fail("fused"))
    trained(scene, tmp_path / "a", pipe)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize("pays", [False, True], ids=["dense", "lazy"])
@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_a_host_that_runs_ahead_without_room_gives_the_same_bytes(
    wide_scene, tmp_path, monkeypatch, lazy, options, pays, _
):
    """Room for one instance at first, and never for more than the last visit needed: many steps halt."""
    monkeypatch.setattr(LazyRows, "_pays", lambda self: pays)
    plain = trained(wide_scene, tmp_path / "plain", "--plain_step", *options)
    assert trained(wide_scene, tmp_path / "ahead", *options) == plain
    halts, repeat = [], run_ahead.RunAhead._repeat
    monkeypatch.setattr(run_ahead.RunAhead, "_repeat", lambda *x: (halts.append(1), repeat(*x)))
    monkeypatch.setattr(run_ahead, "_with_spare", lambda count: count)
    for name in ("_INSTANCES", "_SLOTS"):
        monkeypatch.setattr(ahead, name, 0)
    monkeypatch.setattr(ahead, "_LEAST", 1)
    assert trained(wide_scene, tmp_path / "halting", *options) == plain
    assert len(halts) > 5 and bool(lazy) == (pays and "sparse_adam" not in options)
