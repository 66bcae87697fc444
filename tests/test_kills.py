"""The check of killed trainings: one trial, and the differences that it must notice."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from kills import trials
from kills.trials import _differences, _state

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_killed_training_ends_as_if_it_had_not_been():
    done = subprocess.run([sys.executable, "-m", "tests.kills", "2", "4"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "0 ended differently" in done.stdout, done.stdout + done.stderr


def test_what_is_left_over_missing_or_different_is_noticed(tmp_path):
    (tmp_path / "point_cloud.ply").write_bytes(b"ply")
    (tmp_path / "train_log.json").write_text("{}")
    wanted = _state(tmp_path)
    (tmp_path / "point_cloud.ply").write_bytes(b"pla")
    (tmp_path / "train_log.json").rename(tmp_path / ".chkpnt20.7.tmp.pth")
    said = _differences(wanted, _state(tmp_path))
    assert said == ["train_log.json is missing", ".chkpnt20.7.tmp.pth is left over", "point_cloud.ply differs"]


def test_aimed_kills_leave_half_a_file_or_a_whole_one(tmp_path, monkeypatch):
    killed = []
    monkeypatch.setattr("os.kill", lambda process, signal: killed.append(signal))
    path = tmp_path / "file"
    for moment, size in (("before", 8), ("in", 4), ("after", 8)):
        path.write_bytes(b"12345678")
        act = trials._killer(moment, 1)
        for number in range(3):
            for now in trials.MOMENTS:
                act(now, number, path)
        assert path.stat().st_size == size
    assert len(killed) == 3
