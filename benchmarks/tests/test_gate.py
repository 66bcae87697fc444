"""The gate: its judgement on made-up numbers, the stored file, the older build, and the command's exit status."""

import json
import math
import re

import pytest

from benchmarks.gate import __main__ as gate
from benchmarks.gate import baseline, trainings
from benchmarks.gate.baseline import judge_quality, judge_time
from utils.system_utils import UserError

STORED = [
    {"seed": seed, "PSNR": 30.0 + offset, "SSIM": 0.9 + offset / 100, "Gaussians": 1000 + seed, "bytes": 62000 + seed}
    for seed, offset in enumerate((-0.2, -0.1, 0.0, 0.1, 0.2))
]
DEVIATION = math.sqrt(0.025)  # of the PSNR: of -0.2, -0.1, 0, 0.1 and 0.2 with n - 1
RECORD = {"commit": "a" * 40, "iterations": 1000, "scenes": {"a": STORED, "b": STORED, "c": STORED}}


def _found(**changed: float) -> list[dict[str, float]]:
    mean = {"PSNR": 30.0, "SSIM": 0.9, "Gaussians": 1002, "bytes": 62002}
    return [mean | changed, mean | changed]


def _worse(found: list[dict[str, float]]) -> list[str]:
    return [row.name for row in judge_quality("a", STORED, found) if not row.passed]


@pytest.mark.parametrize(("name", "mean", "deviation"), [
    ("PSNR", 30, -DEVIATION),
    ("SSIM", 0.9, -DEVIATION / 100),
    ("Gaussians", 1002, 1002 * 0.002),  # the seeds agree to 0.16 %, so the least deviation of 0.2 % counts
    ("bytes", 62002, 62002 * 0.002),
])  # fmt: skip
def test_three_deviations_are_allowed(name, mean, deviation):
    assert _worse(_found(**{name: mean + 2.99 * deviation})) == []
    assert _worse(_found(**{name: mean + 3.01 * deviation})) == [name]


@pytest.mark.parametrize(("pairs", "ratio", "passed"), [
    ([(10.9, 10.0), (13.1, 12.0)], 1.0908, True),
    ([(11.2, 10.0), (13.3, 12.0)], 1.1142, False),
    ([(20.0, 10.0), (5.0, 10.0)], 1.0, True),  # ratios are averaged as logarithms
])  # fmt: skip
def test_time_may_rise_by_a_tenth(pairs, ratio, passed):
    row = judge_time("a", pairs)
    assert (round(row.found, 4), row.passed) == (ratio, passed)


@pytest.mark.parametrize(("content", "scenes", "iterations", "complaint"), [
    (None, "abc", 1000, "has no baseline of this kind of machine"),
    ("{", "abc", 1000, "is not JSON"),
    (json.dumps({"kind": RECORD}), "abd", 1000, "is of a, b, c at 1000 iterations, not of a, b, d at 1000"),
    (json.dumps({"kind": RECORD}), "abc", 30, "is of a, b, c at 1000 iterations, not of a, b, c at 30"),
    (json.dumps({"kind": RECORD | {"commit": "--output=x"}}), "abc", 1000, "broken baseline"),
    (json.dumps({"kind": RECORD | {"scenes": {"a": [{"PSNR": 1.0}] * 2}}}), "a", 1000, "broken baseline"),
])  # fmt: skip
def test_a_baseline_that_does_not_fit_says_what_to_do(tmp_path, content, scenes, iterations, complaint):
    path = tmp_path / "gate.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=f"{re.escape(complaint)}.*; .*python -m benchmarks.gate --write --baseline"):
        baseline.read_baseline(path, "kind", list(scenes), iterations)


USUAL = ("this", "stored", "stored", "this")


@pytest.fixture
def stand_in(monkeypatch, tmp_path):
    """The command with trainings that only say what they would have measured; returns its arguments and the turns."""
    turns: list[tuple[int, str]] = []
    seconds = {"this": 10.0, "stored": 10.0, "quiet from turn": 0}

    def timed(task, seed, build):
        name = "this" if build is None else "stored"
        turns.append((seed, name))
        slow = turns.count((seed, name)) < seconds["quiet from turn"]
        return seconds[name] * (1.2 if slow and name == "this" else 1)

    def scored(task, seed):
        return STORED[seed] | {"seconds": timed(task, seed, None), "hash": ""}

    monkeypatch.setattr(gate, "list_tasks", lambda iterations: {name: None for name in "abc"})
    monkeypatch.setattr(gate, "build_older", lambda commit: trainings.Build(tmp_path, None))
    monkeypatch.setattr(gate, "train_and_time", timed)
    monkeypatch.setattr(gate, "train_and_score", scored)
    monkeypatch.setattr(gate, "read_head", lambda: "d" * 40)
    path = tmp_path / "gate.json"
    monkeypatch.setattr("sys.argv", ["gate", "--baseline", str(path)])
    return path, turns, seconds


def test_the_gate_is_written_and_then_passed(monkeypatch, stand_in, capsys):
    path, turns, seconds = stand_in

    def said() -> str:
        del turns[:]
        gate.main()
        return capsys.readouterr().out

    with monkeypatch.context() as patch:
        patch.setattr("sys.argv", ["gate", "--baseline", str(path), "--write"])
        said()
    assert list(json.loads(path.read_text()).values()) == [RECORD | {"commit": "d" * 40}]
    assert said().endswith("the gate is passed\n")
    assert turns == [(seed, name) for seed in (0, 1) for name in USUAL] * 3
    seconds["quiet from turn"] = 3  # the first scene's third turn is its first after the usual two
    assert said().endswith("the gate is passed\n")
    assert turns[:6] == [(0, name) for name in (*USUAL, "stored", "this")] and len(turns) == 2 * (4 * 3 + 2)
    seconds["this"] = 11.5
    with pytest.raises(SystemExit, match="1"):
        said()
    printed = capsys.readouterr().out
    assert printed.endswith("3 of 15 are worse than at ddddddd\n") and printed.count("WORSE") == 3
    assert turns.count((0, "this")) == turns.count((0, "stored")) == 3 * gate.MOST_TURNS


def test_the_stored_file_fits_the_code():
    if not baseline.FILE.is_file():
        pytest.skip("no baseline is stored yet")
    for kind, record in json.loads(baseline.FILE.read_text()).items():
        iterations = gate.ITERATIONS["cpu" if kind.startswith("CPU ") else "cuda"]
        for names in (list(trainings.REAL), list(trainings.MADE)):  # any clone of the repository can make the second
            found = baseline.read_baseline(baseline.FILE, kind, names, iterations)
            assert found["scenes"] == {name: record["scenes"][name] for name in names}
