"""train.py's process: what it imports, the seconds that it notes, its clock and its threads."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import train
from groundwork.host import machine

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
def test_a_training_imports_nothing_that_it_does_not_use(blender_scene, tmp_path):
    """A checkpoint takes the optimiser's state. Another process draws the curve."""
    assert _loaded(blender_scene, tmp_path, "--eval", "--checkpoint_iterations", "6") == []
    assert (tmp_path / "error_vs_time.png").is_file()
    resumed = ["--start_checkpoint", str(tmp_path / "chkpnt6.pth"), "--optimizer_type", "sparse_adam"]
    assert _loaded(blender_scene, tmp_path, "--eval", "--no_curve", *resumed) == []


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
