"""Advice after a training: what made-up logs and curves are told, at the end of train.py and by doctor.py."""

import json
import re
import sys

import pytest

import train
from arguments import OptimizationParams
from splatting.evaluation.error_curve import COLUMNS, NAME, Row, write_curve
from splatting.evaluation.training_log import NAME as LOG
from splatting.findings import Severity
from splatting.findings.model import check_training
from splatting.findings.training import what_to_try

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


def test_training_says_it_at_its_end(colmap_scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it
    words = ["-s", str(colmap_scene), "-m", str(tmp_path), "--eval", "--iterations", "12", "-r", "32"]
    words += ["--densify_from_iter", "4", "--densification_interval", "2", "--densify_grad_threshold", "1e-7"]
    train.main([*words, "--disable_viewer", "--test_iterations", "2", "12", "--max_num_splats", "340"])
    last = json.loads((tmp_path / LOG).read_text())[-1]
    assert last["iterations_planned"] == 12 and last["max_num_splats"] == 340 and "default_budget" not in last
    told = "there was no room for more Gaussians (--max_num_splats 340)"
    assert told in capsys.readouterr().out and told in " ".join(last["lines"])
    assert [told in line.text for line in check_training(tmp_path)] == [True]
