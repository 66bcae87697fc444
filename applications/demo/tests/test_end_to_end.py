"""A small demo scene: trained, rendered, scored and reported by the commands that users type."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from synthetic import folder_state

from applications.demo.make_scene import make_scene

pytest.importorskip("diff_gaussian_rasterization", reason="the extensions are not built: make test")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
ITERATIONS = 300
VIEWS = 36
HELD_OUT = [0, 8, 16, 24, 32]


def run(*command: object) -> str:
    words = [sys.executable, *map(str, command)]
    # A proxy that refuses connections, so that LPIPS does not download its weights.
    environment = os.environ | {"TORCH_HOME": os.devnull, "https_proxy": "http://127.0.0.1:9"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _train(folder: Path) -> None:
    """Make a scene, train a model on it, and keep what train.py and render.py print."""
    scene, model = folder / "scene", folder / "model"
    make_scene(scene, VIEWS, 120, 90, 3000, seed=0)
    before = folder_state(scene)
    training = run("train.py", "-s", scene, "-m", model, "--eval", "--iterations", ITERATIONS,
                   "--densify_from_iter", 100, "--test_iterations", 1, ITERATIONS)  # fmt: skip
    said = {
        "training": training,
        "rendering": run("render.py", "-m", model),
        "scene_as_before": before == folder_state(scene),
    }
    (folder / "said.json").write_text(json.dumps(said))


@pytest.fixture(scope="module")
def trained(once) -> SimpleNamespace:
    """A scene, the model trained on it, the output of the programs, and whether the scene is as before."""
    folder = once("end_to_end", _train)
    said = json.loads((folder / "said.json").read_text())
    return SimpleNamespace(scene=folder / "scene", model=folder / "model", **said)


def test_training_leaves_the_files_of_the_contract_and_the_dataset_alone(trained):
    files = {str(file.relative_to(trained.model)) for file in trained.model.rglob("*") if file.is_file()}
    expected = {"cfg_args", "cameras.json", "input.ply", f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply"}
    assert expected <= files
    assert not [name for name in files if ".tmp" in name]
    assert trained.scene_as_before


def test_renders_are_numbered_and_stand_beside_their_ground_truth(trained):
    for name, views in (("test", HELD_OUT), ("train", sorted(set(range(VIEWS)) - set(HELD_OUT)))):
        folder = trained.model / name / f"ours_{ITERATIONS}"
        numbered = [f"{k:05d}.png" for k in range(len(views))]
        assert sorted(file.name for file in (folder / "renders").iterdir()) == numbered
        for png, view in zip(numbered, views, strict=True):
            with (
                Image.open(folder / "gt" / png) as truth,
                Image.open(trained.scene / f"images/view_{view:03d}.png") as photo,
            ):
                assert np.array_equal(np.asarray(truth), np.asarray(photo))
        assert f"{name}: {len(views)} views, median " in trained.rendering


def test_scores_of_the_held_out_views(trained, tmp_path):
    done = run("metrics.py", "-m", trained.model, "--lpips_net", "alex")
    assert "warning" not in done
    scores = json.loads((trained.model / "results.json").read_text())[f"ours_{ITERATIONS}"]
    assert list(scores) == ["SSIM", "PSNR", "LPIPS", "LPIPS_alex"]
    start = float(re.search(r"\[ITER 1\] Evaluating test: L1 \S+ PSNR ([\d.]+)", trained.training)[1])
    assert start < 15
    # Measured: 23.6 dB and SSIM 0.80; 20.4 dB at iteration 200, 22.5 dB without densification.
    assert scores["PSNR"] > 23.0
    assert scores["SSIM"] > 0.78
    reported = float(re.search(rf"\[ITER {ITERATIONS}\] Evaluating test: L1 \S+ PSNR ([\d.]+)", trained.training)[1])
    # The report averages the PSNRs of three channels of unrounded pixels; the score is one error over 8-bit pixels.
    assert abs(reported - scores["PSNR"]) < 0.5

    said = run("-m", "applications.demo.report", trained.model)
    assert re.search(rf"scene\s+{ITERATIONS}\s+\d+ s\s+\d+\s+5\s+{scores['PSNR']:.2f} dB\s+{scores['SSIM']:.4f}", said)
    with Image.open(trained.model / "contact_sheet.png") as sheet:
        assert sheet.width > 3 * 120 and sheet.height > 4 * 90
    assert "contact_sheet.png" in said
