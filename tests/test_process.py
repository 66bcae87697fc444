"""train.py's process: what it imports and begins early, the seconds that it notes, its clock and its threads."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from waiting import wait_for

import train
from groundwork.host import clock, machine, start
from scene import Scene
from scene.gaussians.adam import undecorated
from splatting.records.training_log import Stopwatch

ROOT = Path(__file__).parents[1]
UNUSED = ("torch._dynamo", "torch._inductor", "torch.onnx", "matplotlib")
UNUSED += ("pycolmap", "scipy", "skimage", "torchvision", "lpips", "sympy", "networkx", "pandas", "triton")
LOADED = """
import sys
import groundwork.host.openmp
import torch, numpy, PIL.Image
before = set(sys.modules)
import train
train.main(sys.argv[2:])
print("loaded:", *sorted(set(sys.argv[1].split(",")) & (set(sys.modules) - before)), file=sys.__stdout__)
"""


TEAMS = """
import os, sys, threading, time
os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:2])
import torch
import gaussian_renderer
names = [thread.name for thread in threading.enumerate()]
torch.zeros(1 << 20).mul_(2)
end = time.monotonic() + 20
while len(os.listdir("/proc/self/task")) < 2 + 2 * names.count("idle OpenMP team") and time.monotonic() < end:
    time.sleep(0.01)
print(names.count("idle OpenMP team"), len(os.listdir("/proc/self/task")) > 3)
"""


def _train(scene: Path, out: Path, *more: object, iterations: int = 3) -> dict:
    """The last record of the log of a training."""
    train.main(["-s", str(scene), "-m", str(out), "-r", "24", "--iterations", str(iterations), *map(str, more)])
    return json.loads((out / "train_log.json").read_text())[-1]


def _loaded(scene: Path, out: Path, *more: str) -> list[str]:
    """Modules of UNUSED that a training loads in a process of its own, besides those of torch itself."""
    words = [",".join(UNUSED), "-s", scene, "-m", out, "-r", "24", "--iterations", "12", *more]
    done = subprocess.run(
        [sys.executable, "-c", LOADED, *map(str, words)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()[1:]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="is of GNU's OpenMP")
@pytest.mark.parametrize(("more", "wanted"), [({}, "1 True"), ({"GOMP_SPINCOUNT": "5"}, "0 False")])
def test_a_program_that_imports_torch_first_has_more_threads_than_cores_so_that_none_spins_for_long(more, wanted):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("has one core, on which torch's threads do not wait for each other")
    names = {"OMP_NUM_THREADS", "GOMP_SPINCOUNT", "OMP_WAIT_POLICY"}
    environment = {name: value for name, value in os.environ.items() if name not in names} | more
    done = subprocess.run([sys.executable, "-c", TEAMS], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == wanted, done.stderr


@pytest.mark.slow
def test_a_training_imports_nothing_that_it_does_not_use(blender_scene, tmp_path):
    """A checkpoint takes the optimiser's state. Another process draws the curve."""
    assert _loaded(blender_scene, tmp_path, "--eval", "--checkpoint_iterations", "6") == []
    assert (tmp_path / "error_vs_time.png").is_file()
    resumed = ["--start_checkpoint", str(tmp_path / "chkpnt6.pth"), "--optimizer_type", "sparse_adam"]
    assert _loaded(blender_scene, tmp_path, "--eval", "--no_curve", *resumed) == []


def _decorated(name: str) -> bool:
    return undecorated(getattr(torch.optim.Adam, name)) is not getattr(torch.optim.Adam, name)


def test_methods_keep_torchs_decorator_once_its_compiler_is_there(monkeypatch):
    monkeypatch.delitem(sys.modules, "torch._dynamo", raising=False)
    assert _decorated("add_param_group") and _decorated("state_dict") and _decorated("load_state_dict")
    assert not _decorated("step")
    monkeypatch.setitem(sys.modules, "torch._dynamo", torch)
    assert not _decorated("add_param_group")


def test_the_last_record_says_where_the_time_went(colmap_scene, tmp_path):
    record = _train(colmap_scene, tmp_path / "out", "--eval", "--test_iterations", 2, "--checkpoint_iterations", 2)
    parts = [record[f"{name}_seconds"] for name in ("training", "scoring", "saving")]
    assert all(part > 0 for part in parts)
    assert record["training_seconds"] == record["seconds"]
    assert record["first_iteration_seconds"] + sum(parts[1:]) <= record["wall_seconds"]
    log = json.loads((tmp_path / "out" / "train_log.json").read_text())
    assert not any("training_seconds" in earlier for earlier in log[:-1])
    resumed = ["--start_checkpoint", tmp_path / "out" / "chkpnt2.pth"]
    record = _train(colmap_scene, tmp_path / "out", "--eval", "--test_iterations", -1, *resumed)
    assert record["training_seconds"] < record["seconds"]  # the former are of this process alone


def test_pictures_are_decoded_while_the_model_is_made(colmap_scene, tmp_path, monkeypatch):
    kept = []
    plain = Scene.create_gaussians

    def create(scene: Scene) -> None:
        kept.append((len(scene.images), scene.images.ahead))
        plain(scene)

    monkeypatch.setattr(Scene, "create_gaussians", create)
    _train(colmap_scene, tmp_path / "out", iterations=2)
    assert kept == [(2, kept[0][1])] and kept[0][1] >= 2  # as many as there are iterations


@pytest.mark.parametrize(
    ("initialised", "expected"), [(0, ["init", "device 0", "context"]), (100, ["init"]), (None, [])]
)
def test_the_gpus_context_is_made_in_a_thread(monkeypatch, initialised, expected):
    """initialised: the driver's answer; None: there is no driver."""
    calls = []

    def load(name: str) -> SimpleNamespace:
        assert name == "libcuda.so.1" and threading.current_thread().name == "cuda start"
        if initialised is None:
            raise OSError("no such library")
        return SimpleNamespace(
            cuInit=lambda flags: calls.append("init") or initialised,
            cuDeviceGet=lambda device, number: calls.append(f"device {number}") or 0,
            cuDevicePrimaryCtxRetain=lambda context, device: calls.append("context") or 0,
        )

    monkeypatch.setattr(start.ctypes, "CDLL", load)
    monkeypatch.setattr(start, "_computes_on_a_gpu", lambda: True)
    thread = start.begin_cuda()
    thread.join()
    assert calls == expected
    assert not thread.daemon  # the driver must not be left in the middle of it


def test_what_was_built_with_cuda_is_known_before_torch_is_there(tmp_path):
    """In a fresh process, as the extension is found without being imported."""
    code = "import sys\nfrom groundwork.host import start\n"
    code += "print(start._computes_on_a_gpu(), 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    from diff_gaussian_rasterization import has_cuda_kernels

    assert done.stdout.split() == [str(has_cuda_kernels()), "False"]


# The clock that stands still while its process is stopped, and only then


# Prints the seconds of some work: by the clock, and by the wall.
CLOCK = """
import sys, time
from groundwork.host.clock import running_seconds, tick
user = lambda: None
tick(user)
WORK = {"hold the lock": lambda: sum(range(2 * 10**8)), "read": input}
began, at = running_seconds(), time.monotonic()
print("ready", flush=True)
WORK[sys.argv[1]]()
print(running_seconds() - began, time.monotonic() - at)
"""


def _counted(work: str, stopped: float = 0.0) -> tuple[float, float]:
    """Seconds that the clock counts for some work, and those of the wall. stopped: seconds of it."""
    command = [sys.executable, "-c", CLOCK, work]
    with subprocess.Popen(command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "ready\n"
        if stopped:
            time.sleep(0.5)
            process.send_signal(signal.SIGSTOP)
            time.sleep(stopped)
            process.send_signal(signal.SIGCONT)
        said, _ = process.communicate("\n")
        counted, wall = map(float, said.split())
        return counted, wall


def test_seconds_of_a_stopped_process_do_not_count():
    counted, wall = _counted("read", stopped=3.0)
    assert wall > 3.0 and counted < wall - 2.5


def test_the_thread_of_the_clock_ends_with_its_stopwatch():
    before = threading.enumerate()
    watch = Stopwatch()
    (thread,) = set(threading.enumerate()).difference(before)
    time.sleep(2 * clock._TICK)
    assert thread.is_alive()
    del watch
    wait_for(lambda: not thread.is_alive())


@pytest.mark.slow
def test_seconds_of_work_count_also_where_no_other_thread_may_look_at_the_clock():
    counted, wall = _counted("hold the lock")
    assert counted == pytest.approx(wall, abs=0.5)


# The number of threads for photos: at most the number of processors that the process may use


@pytest.fixture
def made(monkeypatch, tmp_path):
    """A function that simulates a machine of 64 processors, of which the process may use some; limits by cgroup."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(machine, "_CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "_OWN_CGROUPS", tmp_path / "own")

    def make(affinity: int, own: str = "/", **limits: str) -> None:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(affinity)), raising=False)
        (tmp_path / "own").write_text(f"1:cpu:/old\n0::{own}\n")
        for group, limit in limits.items():
            (tmp_path / group.replace("_", "/")).mkdir(parents=True, exist_ok=True)
            (tmp_path / group.replace("_", "/") / "cpu.max").write_text(limit)

    return make


def test_affinity(made):
    made(2)
    assert machine.cores() == machine.threads() == 2
    made(64)
    assert machine.cores() == 64 and machine.threads() == machine.MOST_THREADS and machine.threads(5) == 5


@pytest.mark.parametrize(
    ("outer", "inner", "count"),
    [
        ("max 100000", "max 100000", 8),
        ("max 100000", "250000 100000", 3),
        ("100000 100000", "400000 100000", 1),
        ("x", "5000 100000", 1),
    ],
)
def test_quota_of_the_group_and_those_around_it(made, outer, inner, count):
    made(8, "/outer/inner", outer=outer, outer_inner=inner)
    assert machine.cores() == count


def test_without_cgroups_or_affinity(made, monkeypatch, tmp_path):
    made(8)
    (tmp_path / "own").unlink()
    assert machine.cores() == 8
    monkeypatch.delattr(os, "sched_getaffinity")
    assert machine.cores() == 64
