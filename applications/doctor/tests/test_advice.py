"""Advice on options: before a training, of a scene whose truth is known; after it, of made-up logs and curves."""

import argparse
import json
import os
import re
import signal
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from waiting import wait_for

import splatting.checks
import train
from applications.doctor import advice
from applications.doctor.model import check_training
from arguments import OptimizationParams
from groundwork.files.json_files import write_json
from groundwork.finding import Severity, note
from scene.readers.tracks import PhotoPoints
from splatting.checks import check_overfitting
from splatting.records.error_curve import COLUMNS, NAME, Row, write_curve
from splatting.records.training_log import NAME as LOG
from utils.system_utils import UserError

SIDE = 20


def _track(points: np.ndarray, ranks: np.ndarray) -> PhotoPoints:
    """A track of points that lie at the pixel of their rank."""
    places = (np.stack([ranks % SIDE, ranks // SIDE], axis=1) + 0.5) / SIDE
    ones = np.ones(len(ranks))
    return PhotoPoints(points, np.zeros((len(ranks), 2)), places, ones, ones, ranks)


def test_photos_of_a_point_from_twice_as_far_have_twice_the_depth_in_focal_lengths():
    points = np.random.default_rng(0).normal(size=(30, 3))
    views = [SimpleNamespace(R=np.eye(3), T=np.array([0, 0, z]), fx=f) for z, f in ((100.0, 50.0), (400.0, 100.0))]
    tracks = [_track(points, np.arange(30)), None, _track(points, np.arange(30))]
    assert abs(advice.measure_distance_ratio([views[0], views[0], views[1]], tracks) - 2) < 0.05


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


def test_a_short_training_that_fails_says_why_and_one_that_is_interrupted_leaves_no_process(tmp_path, capfd):
    with pytest.raises(UserError, match="^no scene$"):
        advice._train([sys.executable, "-c", "import sys; sys.exit(' 50%|##\\nx\\nerror: no scene')"])
    assert capfd.readouterr().err == " 50%|##\n"
    number = tmp_path / "number"
    code = f"import os, time; open({str(number)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    # The handler of SIGINT, which a program in the background ignores, runs where the main thread is interrupted.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    main = threading.main_thread().ident

    def interrupt() -> None:
        try:
            wait_for(lambda: number.exists() and number.read_text())
        finally:
            signal.pthread_kill(main, signal.SIGINT)

    threading.Thread(target=interrupt).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            advice._train([sys.executable, "-c", code])
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


def _curve(test: list[float], train_views: list[float]) -> list[Row]:
    """Points at 2000, 4000, ... iterations, of which each takes 10 ms."""
    rows = []
    for i, (score, other, count) in enumerate(zip(test, train_views, (1000, 1500, 4000, 8000), strict=True), 1):
        row = {"iteration": 2000 * i, "seconds": 20.0 * i, "test_psnr": score, "train_psnr": other, "gaussians": count}
        rows.append(dict.fromkeys(COLUMNS) | row)
    return rows


RISING = [20.0, 24.0, 26.0, 28.0]
FALLING = [20.0, 24.0, 23.0, 22.5]
OF_MCMC = {"iteration": 8000, "strategy": "mcmc"}


@pytest.mark.parametrize(("record", "parts"), [  # numbers and options, each after the one before
    ({}, ["4000", "+4.00 dB", "1.50 dB", "try --strategy mcmc or", "--max_num_splats 4000"]),
    (OF_MCMC, ["try fewer", "--max_num_splats 4000"]),
    ({"iteration": 8000, "strategy": "budget"}, ["try --strategy mcmc", "fewer", "--max"]),
])  # fmt: skip
def test_an_overfitting_is_told_with_options_to_try(record, parts):
    (said,) = check_overfitting(_curve(FALLING, RISING), [record])
    assert re.search(".*?".join(map(re.escape, parts)), str(said)), said
    named = set(re.findall(r"--(\w+)", str(said)))
    assert named and named <= {option.name for option in OptimizationParams.options} | {"sh_degree"}
    both_fall = [20.0, 29.0, 28.0, 27.0]  # a reset, or rates too high
    assert not [*check_overfitting(_curve(RISING, RISING), [{}]), *check_overfitting(_curve(FALLING, both_fall), [{}])]


def test_doctor_repeats_it(tmp_path):
    assert check_training(tmp_path) == []
    write_curve(tmp_path / NAME, _curve(FALLING, RISING))
    (line,) = check_training(tmp_path)
    assert line.severity == Severity.NOTE and line.text.startswith("From iteration 4000")
    (tmp_path / LOG).write_text(json.dumps([OF_MCMC | {"seconds": 80.0}]))
    (line,) = check_training(tmp_path)
    assert line.remedy.startswith("try fewer")
    for broken in ("{", '[{"iteration": 8000, "seconds": 80.0, "loss": "8000"}]'):
        (tmp_path / LOG).write_text(broken)
        (line,) = check_training(tmp_path)
        assert "cannot be read as a training log" in line.text and line.remedy == "train again to record one"


@pytest.mark.parametrize("overfits", [False, True])
def test_training_says_it_at_its_end(colmap_scene, tmp_path, capsys, monkeypatch, overfits):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it
    if overfits:
        monkeypatch.setattr(splatting.checks, "gain_since_peak", lambda rows: 1.5)
        monkeypatch.setattr(splatting.checks, "peak", lambda rows: (rows[0], 0.5))
    words = ["-s", str(colmap_scene), "-m", str(tmp_path), "--eval", "--iterations", "12", "-r", "32"]
    train.main([*words, "--strategy", "budget", "--disable_viewer", "--test_iterations", "2", "12"])
    last = json.loads((tmp_path / LOG).read_text())[-1]
    assert last["strategy"] == "budget"
    told = "only the training photos were fitted (+1.50 dB), and the test views lost 0.50 dB; try --strategy mcmc"
    assert (told in capsys.readouterr().out) == (told in " ".join(last["lines"])) == overfits
    assert [told in str(line) for line in check_training(tmp_path)] == [True] * overfits
