"""The worked examples of parts (tests/parts/example): each is a file, options and a line, and resumes to the byte."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from forks import Done, fork

ROOT = Path(__file__).resolve().parents[1]
WITH_EXAMPLE = '''
import sys
from pathlib import Path
sys.path.append("tests")
from other_sources import edit
import splatting.features
splatting.features.__path__.append("tests/parts/example")
registered = """
from splatting.features.grey import Grey
from splatting.features.patient import Patient
PARTS = (*PARTS, Patient, Grey)
"""
options = Path("tests/parts/example/options.py").read_text()
edit({"arguments.features": lambda source: source + options, "splatting.registry": lambda source: source + registered})
import train
scene, *words = sys.argv[1:]
options = ["-s", scene, "-r", "48", "--iterations", "40", "--disable_viewer", "--no_curve", "--test_iterations", "-1"]
train.main([*options, *words])
'''


def _train(scene: Path, *words: object) -> Done:
    return fork(WITH_EXAMPLE, str(scene), *map(str, words))


def _ply(out: Path) -> bytes:
    return (out / "point_cloud/iteration_40/point_cloud.ply").read_bytes()


@pytest.mark.slow
def test_an_option_a_term_a_state_and_a_line(colmap_scene, tmp_path):
    plain, whole, resumed = (tmp_path / name for name in ("plain", "whole", "resumed"))
    assert _train(colmap_scene, "-m", plain).status == 0
    done = _train(colmap_scene, "-m", whole, "--grey", 5, "--checkpoint_iterations", 20)
    assert done.status == 0 and "Grey Loss=" in done.stderr and _ply(whole) != _ply(plain), done.stderr
    (said,) = [line.partition(" [")[0] for line in done.stdout.splitlines() if line.startswith("--grey: ")]
    last = float(said.split()[-4])
    checkpoint = whole / "chkpnt20.pth"
    assert 0 < last < 0.8 * torch.load(checkpoint, weights_only=False)[0][10]["grey"]["mean"]
    assert json.loads((whole / "train_log.json").read_text())[-1]["grey"] == pytest.approx(last, abs=1e-4)
    again = _train(colmap_scene, "-m", resumed, "--grey", 5, "--start_checkpoint", checkpoint)
    assert _ply(resumed) == _ply(whole)
    assert said in again.stdout
    without = subprocess.run(
        [sys.executable, "train.py", "-s", colmap_scene, "-m", tmp_path / "no", "--start_checkpoint", checkpoint],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert without.returncode == 2 and "the checkpoint has a state of grey, which this code does not" in without.stderr
    refused = _train(colmap_scene, "-m", tmp_path / "no", "--grey", -1)
    assert "--grey must be at least 0" in refused.stderr


@pytest.mark.slow
def test_a_strategy_with_a_value_for_each_gaussian(colmap_scene, tmp_path):
    often = ["--densify_from_iter", 2, "--densification_interval", 4, "--densify_grad_threshold", 1e-5]
    counts = {}
    for name, words in {"adc": [], "one": ["--strategy", "patient", "--patience", 1]}.items():
        assert _train(colmap_scene, "-m", tmp_path / name, *often, *words).status == 0
        counts[name] = _ply(tmp_path / name)
    assert counts["one"] == counts["adc"]  # who waits for one is adaptive density control
    two, checkpoint = ["--strategy", "patient", *often], tmp_path / "two" / "chkpnt20.pth"
    done = _train(colmap_scene, "-m", tmp_path / "two", "--checkpoint_iterations", 20, *two)
    assert done.status == 0, done.stderr
    streaks = torch.load(checkpoint, weights_only=False)[0][10]["patient"]
    assert {0, 1} <= {*streaks.tolist()} and _ply(tmp_path / "two") != counts["adc"]
    # Its name is in model.json, so the strategy joins late.
    again = _train(colmap_scene, "-m", tmp_path / "resumed", "--start_checkpoint", checkpoint, *often)
    assert again.status == 0 and _ply(tmp_path / "resumed") == _ply(tmp_path / "two"), again.stderr
