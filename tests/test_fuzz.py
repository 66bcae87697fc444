"""A share of the random cases of `python -m tests.fuzz`, and proof that it notices what it looks for."""

import mmap
import random
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from fuzz import worker
from fuzz.crafted_pickles import CRAFTED
from fuzz.pickles import Hostile
from fuzz.sandbox import Sandbox

from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]


def test_random_cases_end_in_a_result_or_a_sentence():
    command = [sys.executable, "-m", "tests.fuzz", "12", "23", "--cases", "330"]  # 30 of each kind
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 findings (colmap " in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="measures itself in /proc")
@pytest.mark.parametrize("what", sorted(CRAFTED))
def test_every_crafted_file_of_torch_ends_in_a_sentence_or_plain_values(tmp_path, what):
    hostile = Hostile(tmp_path)
    hostile.run = lambda rng: hostile.load(CRAFTED[what](rng))
    finding, _, _ = worker._run(hostile, random.Random(what))
    assert finding is None


class _Case:
    def __init__(self, run) -> None:
        self.run = run


def _raise(error: BaseException) -> None:
    raise error


@pytest.mark.skipif(sys.platform != "linux", reason="measures itself in /proc")
@pytest.mark.parametrize(
    ("run", "said"),
    [
        (lambda _: None, None),
        (lambda _: _raise(UserError("no such file; give another")), None),
        (lambda _: _raise(SystemExit(2)), None),
        (lambda _: _raise(UserError("two\nlines")), "a message of several lines"),
        (lambda _: _raise(KeyError("x")), "KeyError: 'x'"),
        (lambda _: _raise(SystemExit(3)), "exit status 3"),
        (lambda _: mmap.mmap(-1, 90 << 20).read(), "MiB"),  # not from memory that the process has kept
        (lambda _: sum(range(50_000_000)), " s"),
    ],
)
def test_findings(run, said, monkeypatch):
    monkeypatch.setattr(worker, "MOST", 50 << 20)
    monkeypatch.setattr(_Case, "seconds", 0.3, raising=False)
    finding, _, _ = worker._run(_Case(run), None)
    assert finding is None if said is None else said in finding


@pytest.mark.parametrize(
    ("program", "seconds", "said"),
    [
        ("import os; os.abort()", 60, "ended with SIGABRT"),
        ("import time; time.sleep(600)", 1, "hangs for more than 1 s"),
    ],
)
def test_crashes_and_hangs(program, seconds, said, monkeypatch):
    monkeypatch.setattr("fuzz.sandbox.CASE", seconds)
    with Sandbox(0) as sandbox:
        folder = tempfile.TemporaryDirectory()
        (Path(folder.name) / "log").touch()
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        sandbox._folder, sandbox._child = folder, subprocess.Popen([sys.executable, "-c", program], **pipes)
        assert said in sandbox.run("colmap", 1)
        assert sandbox._child is None
