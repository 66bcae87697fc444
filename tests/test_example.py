"""The worked example of a part (tests/parts/example/grey): it is one folder and one line, and resumes to the byte."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
WITH_EXAMPLE = """
import sys
import splatting.parts as registry
registry.__path__.append("tests/parts/example")
registry.PARTS = (*registry.PARTS, "grey")
import train
scene, *words = sys.argv[1:]
options = ["-s", scene, "-r", "48", "--iterations", "40", "--disable_viewer", "--no_curve", "--test_iterations", "-1"]
train.main([*options, *words])
"""


def _train(scene: Path, *words: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", WITH_EXAMPLE, str(scene), *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def _ply(out: Path) -> bytes:
    return (out / "point_cloud/iteration_40/point_cloud.ply").read_bytes()


@pytest.mark.slow
def test_an_option_a_term_a_state_and_a_line(colmap_scene, tmp_path):
    plain, whole, resumed = (tmp_path / name for name in ("plain", "whole", "resumed"))
    assert _train(colmap_scene, "-m", plain).returncode == 0
    done = _train(colmap_scene, "-m", whole, "--grey", 5, "--checkpoint_iterations", 20)
    assert done.returncode == 0 and "Grey=" in done.stderr and _ply(whole) != _ply(plain), done.stderr
    (said,) = [line.partition(" [")[0] for line in done.stdout.splitlines() if line.startswith("--grey: ")]
    first, last = (float(word) for word in said.split() if word.startswith("0."))
    assert 0 < last < 0.8 * first
    checkpoint = whole / "chkpnt20.pth"
    assert torch.load(checkpoint, weights_only=False)[0][10]["grey"]["first"] > 0
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
