"""The ways to take a step of training: the fast ones give the bytes of the plain one."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rasterizer_tools import GPU_MARKS

import train
from splatting.training import run
from splatting.training.objective import Objective
from splatting.training.steps import ahead, recorded, run_ahead
from splatting.training.steps.ahead import AheadStep
from splatting.training.steps.choose import step_taker
from splatting.training.steps.fused import FusedStep
from splatting.training.steps.plain import PlainStep
from splatting.training.steps.recorded import RecordedStep
from utils.system_utils import UserError

ITERATIONS = 60
DENSITY = ("--densify_from_iter", 10, "--densification_interval", 20, "--opacity_reset_interval", 30)
OPTIONS = {
    "default": (),
    "sparse": ("--optimizer_type", "sparse_adam", "--random_background"),
    "exposure": ("--train_test_exp", "--antialiasing"),
    "depth": ("-d", "depths", "--depth_l1_weight_init", 1.0),
    "masks": ("--masks", "masks"),
    "degree 0": ("--sh_degree", 0),
    "absgrad": ("--absgrad", "--absgrad_threshold", 2e-4, "--split", "long_axis"),
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


def differences(one: dict[str, bytes | list], other: dict[str, bytes | list]) -> list[str]:
    """What differs between two results of `trained`, in few words."""
    leaves = zip(one["checkpoint"], other["checkpoint"], strict=True)
    found = [f"leaf {n}: {str(a)[:60]} and {str(b)[:60]}" for n, (a, b) in enumerate(leaves) if a != b]
    return found + (["ply"] if one["ply"] != other["ply"] else [])


def fused_iterations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list to which every iteration that is not taken plainly will be appended."""
    fused, advance, take = [], FusedStep.advance, RecordedStep.take
    monkeypatch.setattr(FusedStep, "advance", lambda self, at, *x: (fused.append(at.iteration), advance(self, at, *x)))

    def noted(self, at):
        losses = take(self, at)
        fused.extend([at.iteration] if losses else [])
        return losses

    monkeypatch.setattr(RecordedStep, "take", noted)
    return fused


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_the_fused_step_gives_the_bytes_of_the_plain_one(scene, tmp_path, monkeypatch, options):
    plain = trained(scene, tmp_path / "plain", "--plain_step", *options)
    fused = fused_iterations(monkeypatch)
    assert trained(scene, tmp_path / "fused", *options) == plain
    # Densification, the resets of opacities and the last iteration change rows, or take no step.
    assert sorted({*fused}) == [t for t in range(1, ITERATIONS) if t not in (20, 30, 40)]  # some are repeated


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
    monkeypatch.setattr("splatting.training.loop.step_taker", lambda run: (taken.append(step_taker(run)), taken[-1])[1])

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
    assert fused == list(range(1, 15))  # none is recorded, as the objective is not ours any more


class Immediate:
    """Stands for RunAhead where there is no GPU: every step is done at once."""

    def __init__(self, *_: object) -> None:
        self.settle = self.make_way = lambda: None
        self.give_up = lambda: 0

    def take(self, view: int, step: Callable[[], bool], *_: object) -> bool:
        return step()

    def room(self, view: int | None) -> AbstractContextManager:
        return nullcontext()


class Rerun:
    """Stands for Recorder where there is no GPU: a launch runs the function once more, which reads what lies there."""

    def __init__(self, *_: object) -> None:
        self.launches = self.records = self.released = 0
        MADE.append(self)

    def record(self, body: Callable[[], torch.Tensor]) -> tuple[Callable[[], None], torch.Tensor]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(recorded, "step", lambda *_: None)  # to record a step does not take it
            result = body()
        self.records += 1

        def launch() -> None:
            self.launches += 1
            result.copy_(body())

        return launch, result

    def is_tight(self) -> bool:
        return False

    def release(self) -> None:
        self.released += 1


MADE: list[Rerun] = []


@pytest.fixture
def queued(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are taken as on a GPU."""
    MADE.clear()
    monkeypatch.setattr(ahead, "RunAhead", Immediate)
    monkeypatch.setattr(recorded, "Recorder", Rerun)
    monkeypatch.setattr("splatting.training.loop.step_taker", AheadStep)


ENDS_EARLY = ("--densify_until_iter", 30)  # so that two phases have steps to record


@pytest.mark.parametrize(
    "options",
    [(), OPTIONS["sparse"], ("-w", "--antialiasing"), ENDS_EARLY, OPTIONS["degree 0"], OPTIONS["absgrad"]],
    ids=["default", "sparse", "white", "two phases", "degree 0", "absgrad"],
)
def test_steps_that_are_recorded_give_the_same_bytes(scene, tmp_path, queued, monkeypatch, options):
    record, kinds = RecordedStep._record, []
    monkeypatch.setattr(RecordedStep, "_record", lambda self, at: (record(self, at), kinds.append({*self._records}))[0])
    taken = trained(scene, tmp_path / "recorded", *options)
    assert MADE[0].launches > 40
    assert MADE[0].records >= 3  # tensors that density control has replaced are recorded anew
    assert all(len({kind[-2:] for kind in known}) <= 1 for known in kinds)  # records of another phase go
    assert len(set().union(*kinds)) == (2 if options == ENDS_EARLY else 1)
    monkeypatch.setattr("splatting.training.loop.step_taker", PlainStep)
    assert not differences(taken, trained(scene, tmp_path / "plain", *options))


def test_records_give_their_memory_back_where_it_is_short(scene, tmp_path, queued, monkeypatch):
    taken = trained(scene, tmp_path / "plenty")
    monkeypatch.setattr(Rerun, "is_tight", lambda self: True)
    assert not differences(taken, trained(scene, tmp_path / "short"))
    assert MADE[0].released == 0 and MADE[1].released > 2


OWN_TERMS = {
    "of the image": (True, lambda losses, package, step: losses.total + 0.1 * package["render"].square().mean()),
    "of the iteration": (False, lambda losses, package, step: losses.total * (1 + step.iteration / 100)),
    "of the photo's name": (False, lambda losses, package, step: losses.total * (1 + len(step.camera.image_name))),
}


@pytest.mark.parametrize("own", OWN_TERMS.values(), ids=OWN_TERMS.keys())
def test_a_loss_that_was_changed_is_recorded_only_if_it_is_the_same_in_every_step(
    scene, tmp_path, queued, monkeypatch, own
):
    recordable, term = own
    call = Objective.__call__

    def changed(self, package, step):
        losses = call(self, package, step)
        return losses._replace(total=term(losses, package, step))

    monkeypatch.setattr(Objective, "__call__", changed)
    taken = trained(scene, tmp_path / "queued")
    assert (MADE[0].launches > 40) == recordable and (MADE[0].launches == 0) != recordable
    monkeypatch.setattr("splatting.training.loop.step_taker", PlainStep)
    assert not differences(taken, trained(scene, tmp_path / "plain"))


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
    monkeypatch.setattr(recorded, "Recorder", Rerun)
    monkeypatch.setattr(RecordedStep, "take", lambda *_: None)
    monkeypatch.setattr("splatting.training.loop.step_taker", AheadStep)
    taken, queue = [], AheadStep._queue
    monkeypatch.setattr(AheadStep, "_queue", lambda self, step, x: (taken.append(queue(self, step, x)), taken[-1])[1])
    assert trained(scene, tmp_path / "ahead", *OPTIONS["default"]) == plain
    assert sum(taken) > (10 if term else 40)


def test_a_term_that_appears_when_a_step_is_recorded_is_not_lost(scene, tmp_path, queued, monkeypatch):
    call, make, models, calls = Objective.__call__, run.GaussianModel, [], []

    def with_term(self, package, step):
        calls.append(1)
        losses = call(self, package, step)
        return losses if len(calls) == 1 else losses._replace(total=losses.total + models[-1]._scaling.exp().mean())

    monkeypatch.setattr(run, "GaussianModel", lambda *x: (models.append(make(*x)), calls.clear(), models[-1])[2])
    monkeypatch.setattr(Objective, "__call__", with_term)
    taken = trained(scene, tmp_path / "queued")
    assert MADE[0].launches == 0
    monkeypatch.setattr("splatting.training.loop.step_taker", PlainStep)
    assert not differences(taken, trained(scene, tmp_path / "plain"))


@pytest.mark.parametrize("pipe", ["--compute_cov3D_python", "--convert_SHs_python", "--debug"])
def test_options_that_the_operator_does_not_know_take_the_plain_step(scene, tmp_path, monkeypatch, pipe):
    monkeypatch.setattr(FusedStep, "advance", lambda *_: pytest.fail("fused"))
    trained(scene, tmp_path / "a", pipe)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_a_host_that_runs_ahead_without_room_gives_the_same_bytes(scene, tmp_path, monkeypatch, options, _):
    """Room for one instance at first, and never for more than the last visit needed: many steps halt."""
    plain = trained(scene, tmp_path / "plain", "--plain_step", *options)
    assert trained(scene, tmp_path / "ahead", *options) == plain
    halts, repeat = [], run_ahead.RunAhead._repeat
    monkeypatch.setattr(run_ahead.RunAhead, "_repeat", lambda *x: (halts.append(1), repeat(*x)))
    monkeypatch.setattr(run_ahead, "_with_spare", lambda count: count)
    for name in ("_INSTANCES", "_SLOTS"):
        monkeypatch.setattr(ahead, name, 0)
    monkeypatch.setattr(ahead, "_LEAST", 1)
    assert trained(scene, tmp_path / "halting", *options) == plain
    assert len(halts) > 5


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
@pytest.mark.parametrize("fails", [1, 99])
def test_without_memory_for_a_record_steps_are_queued_one_call_after_the_other(scene, tmp_path, monkeypatch, fails, _):
    wanted = trained(scene, tmp_path / "recorded")
    body, asked, taken = RecordedStep._body, [], []

    def lacking(self, iteration, still):
        asked.append(iteration)
        losses = body(self, iteration, still)
        if len(asked) <= fails:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
        return losses

    take = RecordedStep.take
    monkeypatch.setattr(RecordedStep, "_body", lacking)
    monkeypatch.setattr(RecordedStep, "take", lambda self, at: (taken.append(take(self, at)), taken[-1])[1])
    assert trained(scene, tmp_path / "queued") == wanted
    assert len(asked) == 2 if fails == 99 else len(asked) > 2
    assert any(taken) == (fails == 1)


def _exact_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for what the last visit of a view needed, and no more, so that many steps halt."""
    monkeypatch.setattr(run_ahead, "_with_spare", lambda count: count)


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
@pytest.mark.parametrize("repeated", [0, 1, 3])
def test_memory_that_runs_out_while_room_is_made_leaves_the_last_whole_step(scene, tmp_path, monkeypatch, repeated, _):
    """After so many steps of a halted queue were repeated."""
    wanted = trained(scene, tmp_path / "whole")
    again, left = AheadStep._repeat, [repeated]

    def repeat(self, step, first):
        if step.iteration > 40 and left[0] == 0:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
        left[0] -= step.iteration > 40
        again(self, step, first)

    with monkeypatch.context() as patch:
        _exact_room(patch)
        patch.setattr(AheadStep, "_repeat", repeat)
        with pytest.raises(UserError, match="the model after iteration .* is saved") as caught:
            trained(scene, tmp_path / "out")
    saved = int(re.search(r"after iteration (\d+) is saved", str(caught.value))[1])
    assert 40 <= saved < ITERATIONS
    start = "--start_checkpoint", tmp_path / f"out/chkpnt{saved}.pth"
    assert not differences(trained(scene, tmp_path / "out", *start), wanted)


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_lists_that_are_too_long_for_any_room_end_the_run_with_the_reason(scene, tmp_path, monkeypatch, _):
    """The step is rendered by a host that waits, whose operator says so. 10 stands for 2^31."""
    repeat, measure, halted = run_ahead.RunAhead._repeat, FusedStep.measure, []

    def refusing(self, step):
        if halted:
            raise RuntimeError("more than 10 instances")
        return measure(self, step)

    monkeypatch.setattr(run_ahead.RunAhead, "_repeat", lambda *x: (halted.append(1), repeat(*x)))
    monkeypatch.setattr(FusedStep, "measure", refusing)
    monkeypatch.setattr(run_ahead, "_MOST", 10)
    with pytest.raises(RuntimeError, match="more than 10 instances"):
        trained(scene, tmp_path / "a")


@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_a_run_that_is_killed_right_after_a_halt_resumes_to_the_same_bytes(scene, tmp_path, monkeypatch, _):
    wanted = trained(scene, tmp_path / "whole")
    program = """
import os, signal, sys
sys.path[:0] = ["tests", "."]
import splatting.host.openmp
from pathlib import Path
import test_steps
from splatting.training.steps import run_ahead
repeat = run_ahead.RunAhead._repeat

def repeat_and_die(self, report):
    repeat(self, report)
    if self._done > 30:
        os.kill(os.getpid(), signal.SIGKILL)

run_ahead._with_spare = lambda count: count
run_ahead.RunAhead._repeat = repeat_and_die
test_steps.trained(Path(sys.argv[1]), Path(sys.argv[2]), "--checkpoint_iterations", 25)
"""
    words = [sys.executable, "-c", program, scene, tmp_path / "out"]
    done = subprocess.run(list(map(str, words)), cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    start = "--start_checkpoint", tmp_path / "out/chkpnt25.pth"
    assert not differences(trained(scene, tmp_path / "out", *start), wanted)
