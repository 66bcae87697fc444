"""A share of the random cases of `python -m tests.fuzz`, and proof that it notices what it looks for."""

import mmap
import random
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from fuzz import sandbox, worker
from fuzz.crafted_pickles import CRAFTED
from fuzz.pickles import Hostile

import applications.export  # noqa: F401  (some kinds of cases write by it)
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_random_cases_end_in_a_result_or_a_sentence():
    command = [sys.executable, "-m", "tests.fuzz", "12", "23", "--cases", "200"]  # 20 of each kind
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
    finding, _, _ = worker._run(SimpleNamespace(run=run, seconds=0.3), None)
    assert finding is None if said is None else said in finding


@pytest.mark.parametrize(
    ("program", "seconds", "said"),
    [("import os; os.abort()", 60, "SIGABRT"), ("import time; time.sleep(600)", 1, "hangs for more than 1 s")],
)
def test_crashes_and_hangs(program, seconds, said, monkeypatch):
    monkeypatch.setattr(sandbox, "CASE", seconds)
    monkeypatch.setattr(sandbox, "WORKER", ("-c", f"print('ready', flush=True); input(); {program}"))
    with sandbox.Sandbox(0) as child:
        assert said in child.run("colmap", 1)
