"""The ways to take a step of training: the fast ones give the bytes of the plain one."""

import gc
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from gaussians import needs_fused_step
from rasterizer_tools import GPU_MARKS
from step_ways import Immediate, Rerun, fused_iterations, take_as  # noqa: F401  (a fixture)
from trainings import (
    ITERATIONS,
    OPTIONS,
    differences,
    leaves,
    plain_training,
    shared_scene,
    train_on,
    trained,
    trained_as,
    whole_result,
)

from splatting import loop
from splatting import make_run as making
from splatting import plan as planning
from splatting.faster import captured, faster_steps, speculative
from splatting.faster.captured import CapturedStep
from splatting.faster.faster import FasterSteps
from splatting.faster.fused import FusedStep
from splatting.faster.graphs import Graphs
from splatting.faster.recorder import Recorder
from splatting.iteration import Iteration, Losses
from splatting.objective import Objective
from utils.system_utils import UserError

pytestmark = needs_fused_step
GPU = [pytest.param(None, marks=GPU_MARKS)]
GROWING = ("--opacity_reset_interval", 1000)  # lists get longer to the end, as no reset makes their splats small


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return shared_scene(once)


@pytest.mark.parametrize("name", [name for name in OPTIONS if name != "robust mask"])  # which no host runs ahead of
@pytest.mark.parametrize("_", GPU)
def test_a_host_that_runs_ahead_without_capacity_gives_the_same_bytes(scene, tmp_path, monkeypatch, name, _):
    """Capacity for one instance at first, and never for more than the last visit needed: many steps overflow."""
    plain = trained_as(name, scene, tmp_path / "plain", "--plain_step")
    overflows, replay = [], speculative.Speculation._replay
    monkeypatch.setattr(speculative.Speculation, "_replay", lambda *x: (overflows.append(1), replay(*x)))
    monkeypatch.setattr(speculative, "_add_spare", lambda count, *_: count)
    monkeypatch.setattr(speculative, "_FIRST", (1, 1, 1, 1))
    assert trained_as(name, scene, tmp_path / "overflowing") == plain
    assert len(overflows) > 5


@pytest.mark.parametrize("iteration", [20, 36, ITERATIONS])  # growth, a higher degree, the last
def test_a_gradient_of_nan_ends_in_the_same_way(scene, tmp_path, monkeypatch, iteration):
    call = Objective.__call__

    def broken(self, package, at):
        losses = call(self, package, at)
        zero = 0.0 * package["render"][0, :8, :8].sum()  # whose root has no finite gradient
        return losses._replace(total=losses.total + zero.sqrt()) if at.iteration == iteration else losses

    monkeypatch.setattr(Objective, "__call__", broken)
    ends = []
    for way in ((), ("--plain_step",)):
        out, said = tmp_path / f"out{len(way)}", ""
        try:
            trained(scene, out, *way, "--train_test_exp", "--checkpoint_iterations", iteration, ITERATIONS)
        except UserError as error:
            said = str(error).replace(str(out), "")
        left = {path.name: leaves(torch.load(path, weights_only=False)) for path in out.glob("*.pth")}
        ends.append((said, left))
    assert ends[0] == ends[1] and ends[0][1]


def test_losses_that_are_kept_keep_no_image(scene, tmp_path, monkeypatch):
    """Observers note them until something is due; a graph would keep the image and its gradient that long."""
    measure, told = FusedStep.measure, []

    def noted(self, step):
        measured = measure(self, step)
        total, l1, terms, _ = measured[1]
        told.extend([total, l1, *terms.values()])
        return measured

    monkeypatch.setattr(FusedStep, "measure", noted)
    trained(scene, tmp_path / "a", *OPTIONS["depth"])
    assert len(told) > 100 and not any(value.requires_grad for value in told)


def test_what_may_want_gradients_takes_the_plain_step(scene, tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(loop, "faster_steps", lambda run: (taken.append(faster_steps(run)), taken[-1])[1])

    class WithFurtherTerm(Objective):
        pass

    short = "-r", 48, "--iterations", 2, "--no_curve", "--disable_viewer"
    for name, *pipe in (
        ["a"],
        ["b", "--compute_cov3D_python"],
        ["c", "--convert_SHs_python"],
        ["d", "--detect_anomaly"],
    ):
        train_on(scene, tmp_path / name, *short, *pipe)
    torch.autograd.set_detect_anomaly(False)
    monkeypatch.setattr(making, "Objective", WithFurtherTerm)
    train_on(scene, tmp_path / "e", *short)
    fast = CapturedStep if torch.cuda.is_available() else FusedStep
    assert [type(one) for one in taken] == [fast, *[FasterSteps] * 4]


def test_debug_takes_the_plain_step(scene, tmp_path, monkeypatch):
    fused = fused_iterations(monkeypatch)
    trained(scene, tmp_path / "a", "--debug_from", 15)
    assert fused == [*range(1, 16)]


def of_scales(losses: Losses, package: dict, step: object, scales: torch.Tensor) -> torch.Tensor:
    return losses.total + scales.exp().mean()


def of_image(losses: Losses, package: dict, *_: object) -> torch.Tensor:
    return losses.total + 0.1 * package["render"].square().mean()


@pytest.fixture(scope="module")
def without(once) -> dict:
    """The result of a training without such a term."""
    return whole_result(plain_training(once, "default"), ITERATIONS)


# Terms that somebody adds to our objective after so many of its calls, and how many steps are then not plain. The
# objective is called in the first step, and in the second to capture it.
TERMS = {
    "past the image": (("fused", "queued"), 14, 14, of_scales),
    "past the image from the first step on": (("captured",), 0, 0, of_scales),
    "of the image": (("captured",), 0, 60, of_image),
    "of the iteration": (("captured",), 0, 60, lambda losses, _, at, *__: losses.total * at.iteration),
    "of the photo's name": (("captured",), 0, 60, lambda losses, _, at, *__: losses.total * len(at.camera.image_name)),
}


@pytest.mark.parametrize(("ways", "late", "fused", "term"), TERMS.values(), ids=TERMS.keys())
def test_a_term_that_was_added_is_not_lost(scene, tmp_path, without, monkeypatch, take_as, ways, late, fused, term):  # noqa: F811
    """Gradients past the image make the steps from there on plain; what asks for more than an image is not captured."""
    call, make, models, calls = Objective.__call__, planning.GaussianModel, [], []

    def with_term(self, package, at):
        losses = call(self, package, at)
        calls.append(1)
        return losses if len(calls) <= late else losses._replace(total=term(losses, package, at, models[-1]._scaling))

    monkeypatch.setattr(planning, "GaussianModel", lambda *x: (models.append(make(*x)), calls.clear(), models[-1])[2])
    monkeypatch.setattr(Objective, "__call__", with_term)
    take_as("plain")
    plain = trained_as("default", scene, tmp_path / "plain")
    assert plain != without
    taken = fused_iterations(monkeypatch)
    for way in ways:
        take_as(way)
        taken.clear()
        assert not differences(trained_as("default", scene, tmp_path / way), plain)
        assert len(taken) == fused
    assert bool(sum(made.launches for made in Rerun.made)) == (term is of_image)


def test_graphs_give_their_memory_back_where_it_is_short(scene, tmp_path, without, take_as, monkeypatch):  # noqa: F811
    """Give the bytes of a training without graphs (test_training_bytes.py: launches of those that keep theirs)."""
    take_as("captured")
    monkeypatch.setattr(Rerun, "tight", True)
    assert not differences(trained_as("default", scene, tmp_path), without)
    assert Rerun.made[0].released > 2


@pytest.mark.parametrize("_", GPU)
@pytest.mark.parametrize("fails", [1, 99])
def test_without_memory_for_a_graph_steps_are_queued_one_call_after_the_other(scene, tmp_path, monkeypatch, fails, _):
    wanted = trained(scene, tmp_path / "captured")
    body, launch, asked, taken = Graphs._compute_step, Graphs.launch, [], []

    def lacking(self, iteration, placeholder):
        asked.append(iteration)
        losses = body(self, iteration, placeholder)
        if len(asked) <= fails:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
        return losses

    monkeypatch.setattr(Graphs, "_compute_step", lacking)
    monkeypatch.setattr(Graphs, "launch", lambda self, at: (taken.append(launch(self, at)), taken[-1])[1])
    assert trained(scene, tmp_path / "queued") == wanted
    assert len(asked) == 2 if fails == 99 else len(asked) > 2
    assert any(taken) == (fails == 1)


@pytest.mark.parametrize("_", GPU)
def test_a_graph_without_any_memory_is_an_error_and_no_abort(_):
    """Torch allocates as a capture begins; in a process of its own, as the abort would end this one."""
    code = """
import torch
from splatting.faster.recorder import Recorder
recorder, word = Recorder(torch.device("cuda")), torch.zeros(1, device="cuda")
recorder.capture(word.zero_)
recorder.release()
total = torch.cuda.get_device_properties(0).total_memory
torch.cuda.set_per_process_memory_fraction(torch.cuda.memory_reserved() / total)
try:
    recorder.capture(word.zero_)
except torch.OutOfMemoryError:
    print("out of memory")
torch.cuda.set_per_process_memory_fraction(1.0)
recorder.capture(word.fill_(3.0).zero_)[0]()
print(word.item())
"""
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "out of memory\n0.0\n"), done.stderr


@pytest.mark.parametrize("_", GPU)
def test_graphs_that_nobody_has_any_more_do_not_end_a_capture(_):
    recorder, word = Recorder(torch.device("cuda")), torch.zeros(1, device="cuda")
    unreachable = [recorder.capture(word.zero_)[0]]
    unreachable.append(unreachable)
    del unreachable
    threshold = gc.get_threshold()
    try:
        gc.set_threshold(1, 1, 1)
        launch, _ = recorder.capture(lambda: [[[] for _ in range(1000)], word.fill_(3.0)][1])
    finally:
        gc.set_threshold(*threshold)
    launch()
    assert word.item() == 3


@pytest.mark.parametrize("_", GPU)
def test_a_step_that_waits_for_the_gpu_is_not_captured_and_random_numbers_are_there(scene, tmp_path, monkeypatch, _):
    wanted, body = trained(scene, tmp_path / "captured"), Graphs._compute_step
    monkeypatch.setattr(Graphs, "_compute_step", lambda self, *of: body(self, *of).sum().item())
    assert trained(scene, tmp_path / "queued") == wanted
    assert torch.rand(3, device="cuda").max() < 1
    held = torch.empty(2**28, dtype=torch.uint8, device="cuda")
    reserved = torch.cuda.memory_reserved()
    del held
    torch.cuda.empty_cache()  # gives nothing back while torch believes that it captures
    assert torch.cuda.memory_reserved() <= reserved - 2**28


@pytest.mark.parametrize("_", GPU)
def test_lists_that_are_too_long_for_any_capacity_end_the_run_with_the_reason(scene, tmp_path, monkeypatch, _):
    """The step is rendered by a host that waits, whose operator says so. 10 stands for 2^31."""
    replay, measure, halted = speculative.Speculation._replay, FusedStep.measure, []

    def refusing(self, at, *now):
        if halted:
            raise RuntimeError("more than 10 instances")
        return measure(self, at, *now)

    monkeypatch.setattr(speculative.Speculation, "_replay", lambda *x: (halted.append(1), replay(*x)))
    monkeypatch.setattr(FusedStep, "measure", refusing)
    monkeypatch.setattr(speculative, "_MOST", 10)
    with pytest.raises(RuntimeError, match="more than 10 instances"):
        trained(scene, tmp_path / "a")


@pytest.mark.parametrize("_", GPU)
def test_a_run_that_is_killed_right_after_an_overflow_resumes_to_the_same_bytes(scene, tmp_path, _):
    wanted = trained(scene, tmp_path / "whole", *GROWING)
    program = """
import os, signal, sys
sys.path[:0] = ["tests", "."]
import groundwork.host.openmp
from pathlib import Path
import test_steps
from splatting.faster import speculative
replay = speculative.Speculation._replay

def replay_and_die(self, report):
    replay(self, report)
    if self._done > 30:
        os.kill(os.getpid(), signal.SIGKILL)

speculative._add_spare = lambda count, *_: count
speculative.Speculation._replay = replay_and_die
test_steps.trained(Path(sys.argv[1]), Path(sys.argv[2]), *test_steps.GROWING, "--checkpoint_iterations", 25)
"""
    words = [sys.executable, "-c", program, scene, tmp_path / "out"]
    done = subprocess.run(list(map(str, words)), cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    start = "--start_checkpoint", tmp_path / "out/chkpnt25.pth"
    assert not differences(trained(scene, tmp_path / "out", *GROWING, *start), wanted)


@needs_fused_step
def test_a_graph_may_replay_a_step_that_was_taken_without_one(scene, tmp_path, monkeypatch, take_as):  # noqa: F811
    """The first step of a kind has no graph, and its losses tell of terms; a graph's do not."""

    class Replaying(Immediate):
        def __init__(self, device: torch.device, steps: CapturedStep) -> None:
            super().__init__(device, steps)
            self._held = []
            self.add = self._add

        def _add(self, at: Iteration, losses: Losses) -> None:
            self._pending.append(at)
            self._held.append((at, losses))
            if len(self._held) == 2:
                self._steps.rewind(2)
                for step, first in self._held:
                    self._steps.replay(step, first)

    take_as("captured")
    monkeypatch.setattr(captured, "Speculation", Replaying)
    assert trained(scene, tmp_path / "a", *OPTIONS["appearance"])["ply"]
