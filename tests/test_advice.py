"""Advice on options: before a training, of a scene whose truth is known; after it, of made-up logs and curves."""

import argparse
import inspect
import json
import os
import re
import signal
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from waiting import wait_for

import train
from arguments import OptimizationParams
from scene.readers.tracks import Track
from splatting.evaluation.error_curve import COLUMNS, NAME, Row, write_curve
from splatting.evaluation.training_log import NAME as LOG
from splatting.files.json_files import write_json
from splatting.findings import Severity, advice, note
from splatting.findings.model import check_training
from splatting.findings.training import what_to_try
from splatting.registry import tools
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


def test_what_may_be_advised_is_measured():
    """In the table of what scenes gain that ask for it, or beside: nothing is recommended on other grounds."""
    measured = (advice.ROOT / "docs/results/options.md").read_text().partition("## One fault")[0]
    code = [inspect.getsource(tool) for name in ("advise", "advise_trained") for tool in tools(name)]
    named = {*re.findall(r'"(--\w+)', "".join([*code, inspect.getsource(advice._of_tracks)]))}
    assert named == {"--antialiasing", "--appearance", "--refine_poses", "--robust_mask", "--sky"}
    assert all(f"`{name}" in measured for name in named)


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
        advice._trained([sys.executable, "-c", "import sys; sys.exit(' 50%|##\\nx\\nerror: no scene')"])
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


COUNTS = (1000, 1500, 4000, 8000)


def _curve(test: list[float], train_views: list[float], gaussians: tuple[int, ...] = COUNTS) -> list[Row]:
    """Points at 2000, 4000, ... iterations, of which each takes 10 ms."""
    rows = []
    for i, (score, other, count) in enumerate(zip(test, train_views, gaussians, strict=True), 1):
        row = {"iteration": 2000 * i, "seconds": 20.0 * i, "test_psnr": score, "train_psnr": other, "gaussians": count}
        rows.append(dict.fromkeys(COLUMNS) | row)
    return rows


RISING = [20.0, 24.0, 26.0, 28.0]
FALLING = [20.0, 24.0, 23.0, 22.5]
LATE = [20.0, 27.95, 28.0, 28.02]
FLAT = (1000, 1000, 900, 900)
CAPPED = (1000, 3970, 3999, 3998)
OF_BUDGET = {"iteration": 8000, "strategy": "budget"}
OF_MCMC = {"iteration": 8000, "strategy": "mcmc"}


# What is told: numbers and options, each after the one before.
TOLD = [
    (FALLING, RISING, COUNTS, {}, ["4000", "+4.00 dB", "1.50 dB", "try --strategy mcmc or", "--max_num_splats 4000"]),
    (FALLING, RISING, COUNTS, OF_MCMC, ["try fewer", "--max_num_splats 4000"]),
    (FALLING, RISING, COUNTS, OF_BUDGET, ["try --strategy mcmc", "fewer", "--max"]),
    (FALLING, RISING, CAPPED, {"max_num_splats": 4000}, ["only the training photos"]),  # a higher cap is no remedy
    (FALLING, RISING, COUNTS, {"default_budget": 3200}, ["only the training photos"]),
    (RISING, RISING, CAPPED, {"max_num_splats": 4000}, [
        "4000", "no room", "--max_num_splats 4000", "+4.00 dB", "try --strategy budget", "higher"]),
    (RISING, RISING, FLAT, {}, ["never rose", "1000", "900", "--densify_grad_threshold"]),
    (RISING, RISING, FLAT, OF_MCMC, ["try a higher --max_num_splats", "--mcmc_until_iter"]),
    (RISING, RISING, FLAT, OF_BUDGET, ["try a higher --max_num_splats", "--densify_until_iter"]),
    (RISING, RISING, COUNTS, {"default_budget": 3200}, ["8000", "2.5", "--strategy budget", "3200"]),
    ([20.0, 24.0, 23.9, 23.95], RISING, COUNTS, {}, ["The last 40.0 of 80.0 s"]),
    (LATE, RISING, COUNTS, {}, ["try --iterations 4000 --position_lr_max_steps 4000"]),
]  # fmt: skip


@pytest.mark.parametrize(("test", "train_views", "gaussians", "record", "parts"), TOLD)
def test_what_is_seen_is_told_with_options_to_try(test, train_views, gaussians, record, parts):
    (said,) = what_to_try(_curve(test, train_views, gaussians), [record])
    assert re.search(".*?".join(map(re.escape, parts)), str(said)), said


@pytest.mark.parametrize(
    ("test", "train_views", "gaussians", "record"),
    [
        (RISING, RISING, COUNTS, {"iteration": 8000, "iterations_planned": 8000}),
        (FALLING, [20.0, 29.0, 28.0, 27.0], COUNTS, {}),  # both fall: a reset, or rates too high
        (RISING, RISING, CAPPED, {"max_num_splats": 5000}),
        (RISING, RISING, (100_000, 30_000, 50_000, 60_000), {}),  # from a random start, most are removed first
        (RISING, RISING, COUNTS, {"default_budget": 4001}),
        (LATE, RISING, COUNTS, {"iteration": 8000, "iterations_planned": 30_000}),  # a time budget ended it
        ([20.0, 27.95, 28.0, 28.2], RISING, COUNTS, {}),
    ],
)
def test_a_healthy_training_is_told_nothing(test, train_views, gaussians, record):
    assert what_to_try(_curve(test, train_views, gaussians), [record]) == []


def test_every_option_named_is_one_of_training():
    known = {option.name for option in OptimizationParams.options} | {"sh_degree"}
    said = [what_to_try(_curve(test, views, counts), [record]) for test, views, counts, record, _ in TOLD]
    named = set(re.findall(r"--(\w+)", str(said)))
    assert len(named) >= 6 and named <= known


def test_doctor_repeats_it(tmp_path):
    assert check_training(tmp_path) == []
    write_curve(tmp_path / NAME, _curve([20.0, 24.0, 23.0, 22.5], RISING))
    (line,) = check_training(tmp_path)
    assert line.severity == Severity.NOTE and line.text.startswith("From iteration 4000")
    write_curve(tmp_path / NAME, _curve(RISING, RISING))
    assert check_training(tmp_path) == []
    (tmp_path / LOG).write_text(json.dumps([{"iteration": 8000, "seconds": 80.0, "max_num_splats": 8000}]))
    (line,) = check_training(tmp_path)
    assert "--max_num_splats 8000" in line.text
    for broken in ("{", '[{"iteration": 8000, "seconds": 80.0, "max_num_splats": "8000"}]'):
        (tmp_path / LOG).write_text(broken)
        (line,) = check_training(tmp_path)
        assert "cannot be read as a training log" in line.text and line.remedy == "train again to record one"


@pytest.mark.parametrize("cap", [0, 340])
def test_training_says_it_at_its_end(colmap_scene, tmp_path, capsys, monkeypatch, cap):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it
    words = ["-s", str(colmap_scene), "-m", str(tmp_path), "--eval", "--iterations", "12", "-r", "32"]
    words += ["--densify_from_iter", "4", "--densification_interval", "2", "--densify_grad_threshold", "1e-7"]
    words += ["--max_num_splats", str(cap)]
    train.main([*words, "--disable_viewer", "--test_iterations", "2", "12"])
    last = json.loads((tmp_path / LOG).read_text())[-1]
    assert last["iterations_planned"] == 12 and last.get("max_num_splats") == (cap or None)
    assert last.get("default_budget") == (None if cap else 100_000)
    told = "there was no room for more Gaussians (--max_num_splats 340)"
    assert (told in capsys.readouterr().out) == (told in " ".join(last["lines"])) == bool(cap)
    assert [told in line.text for line in check_training(Path(tmp_path))] == [True] * bool(cap)
