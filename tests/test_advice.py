"""Advice on options: numbers of a scene whose truth is known, and what train.py and doctor.py make of them."""

import argparse
import json
import os
import signal
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from scene.readers.tracks import Track
from splatting.files.json_files import write_json
from splatting.findings import advice, note
from train import parse
from utils.system_utils import UserError

SIDE = 20


def _track(points: np.ndarray, ranks: np.ndarray) -> Track:
    """A track of points that lie at the pixel of their rank."""
    places = (np.stack([ranks % SIDE, ranks // SIDE], axis=1) + 0.5) / SIDE
    ones = np.ones(len(ranks))
    return Track(points, np.zeros((len(ranks), 2)), places, ones, ones, ranks)


def test_photos_of_a_point_from_twice_as_far_have_twice_the_depth_in_focal_lengths():
    points = np.random.default_rng(0).normal(size=(30, 3))
    views = [SimpleNamespace(R=np.eye(3), T=np.array([0, 0, z]), fx=f) for z, f in ((100.0, 50.0), (400.0, 100.0))]
    tracks = [_track(points, np.arange(30)), None, _track(points, np.arange(30))]
    assert abs(advice.distances([views[0], views[0], views[1]], tracks) - 2) < 0.05


def test_advice_on_a_given_option_or_against_one_is_not_taken(tmp_path, monkeypatch, capsys):
    found = [note("", "--sky auto"), note("", "--appearance ppisp --x 1"), note("", "--refine_poses")]
    monkeypatch.setattr(advice, "advise", lambda *_, **__: found)
    args = argparse.Namespace(train_test_exp=False, projection="ray", strategy="adc", advise=True)
    dataset = argparse.Namespace(model_path=str(tmp_path))
    assert advice.asked_options(dataset, args, ["--app=none", "-r", "2"]) == ["--sky", "auto"]
    said = capsys.readouterr().out
    assert "not recommended here: --refine_poses (--refine_poses does not work with" in said
    assert said.count(advice.GUIDE) == 1 and (advice.ROOT / advice.GUIDE).is_file()
    assert [one["options"] for one in json.loads((tmp_path / advice.ADVICE).read_text())] == ["--sky auto", "", ""]


@pytest.mark.parametrize("more", [["--init_type", "random"], ["--init_ply=a.ply"], ["--init_pcd_path=b"], ["-i=c"]])
def test_the_short_training_reads_the_data_as_the_training_does(more, monkeypatch):
    given = ["-s", "scene", "--masks", "a b", "--mask_meaning", "transparent", "--invert_masks", "-w"]
    lines, (_, dataset, *_) = [], parse([*given, *more])

    def fail(line: list[str]) -> None:
        lines.append(line[2:])
        raise UserError("no scene")

    monkeypatch.setattr(advice, "_trained", fail)
    with pytest.raises(UserError, match="^no scene$"):
        next(advice._of_short_training(dataset))
    other = {name for name, value in vars(parse(lines[0])[1]).items() if value != vars(dataset)[name]}
    assert other == {"model_path", "resolution"}


def test_a_short_training_that_fails_says_why_and_one_that_is_interrupted_leaves_no_process(tmp_path):
    with pytest.raises(UserError, match="^no scene$"):
        advice._trained([sys.executable, "-c", "import sys; sys.exit('x\\nerror: no scene')"])
    number = tmp_path / "number"
    code = f"import os, time; open({str(number)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    # The handler of SIGINT, which a program in the background ignores, runs where the main thread is interrupted.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(1.0, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT])
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            advice._trained([sys.executable, "-c", code])
    finally:
        signal.signal(signal.SIGINT, before)
    with pytest.raises(ProcessLookupError):
        os.kill(int(number.read_text()), 0)


def test_a_model_is_not_told_to_take_what_it_was_trained_with(tmp_path, monkeypatch):
    monkeypatch.setattr(advice, "advise", lambda *_, **__: [note("far", "--sky auto")])
    assert len(advice.check_options("scene", "images", str(tmp_path / "none"))) == 1
    (tmp_path / "cfg_args").write_text("Namespace()")
    write_json(tmp_path / "model.json", {"options": {"sky": "auto"}})
    assert advice.check_options("scene", "images", str(tmp_path)) == []
