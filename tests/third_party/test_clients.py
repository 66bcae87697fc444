"""Programs written for the reference's modules run on ours: clients/*.py, in another folder than the project's."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cuda_is_cpu import CudaIsCpu
from PIL import Image
from plyfile import PlyData
from synthetic import FOCAL, HEIGHT, WIDTH, make_colmap_scene
from trainings import train_on

pytest.importorskip("diff_gaussian_rasterization", reason="the extensions are not built: make test")

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
ITERATIONS = 300
DENSIFYING = ("--densify_from_iter", 50, "--densification_interval", 50, "--densify_until_iter", 260)
TRAINING = ("--eval", "--iterations", ITERATIONS, *DENSIFYING)
VIEWS, HELD_OUT = 17, 3


def command(*words: object, cwd: Path) -> None:
    """Run Python with these words in a folder, in a process of its own."""
    places = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]  # packages may be installed there
    env = os.environ | {"PYTHONPATH": os.pathsep.join(places), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, *map(str, words)]
    done = subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        pytest.fail(f"exit status {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}", pytrace=False)


def ply_count(path: Path) -> int:
    return len(PlyData.read(path)["vertex"])


def fell(losses: list[float], by: float = 0.98) -> bool:
    """Tell whether the last quarter of the losses is lower than the first, by this factor."""
    part = max(len(losses) // 4, 1)
    return sum(losses[-part:]) < by * sum(losses[:part])


def _make_scene(scene: Path) -> None:
    """With central principal point and depth maps."""
    model_of_colmap = make_colmap_scene(scene, params=(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    scales = {}
    for image in model_of_colmap.images.values():
        name = os.path.splitext(image.name)[0]
        path = scene / "depths" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH), 20000, dtype=np.uint16)).save(path)
        scales[name] = {"scale": 1.0, "offset": 0.0}
    (scene / "sparse" / "0" / "depth_params.json").write_text(json.dumps(scales))


@pytest.fixture(scope="module")
def world(once) -> SimpleNamespace:
    """A scene, and the model that train.py made of it."""
    scene = once("clients/scene", _make_scene)
    words = *TRAINING, "--test_iterations", ITERATIONS
    model = once("clients/model", lambda out: train_on(scene, out, *words))
    psnr = json.loads((model / "train_log.json").read_text())[-1]["test_psnr"]
    return SimpleNamespace(scene=scene, model=model, psnr=psnr)


@pytest.fixture
def client(world: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run a client; returns what it wrote as its result."""

    def run(name: str, *words: object, out: Path | None = None, alone: bool = False) -> Any:
        """alone: in a process of its own, as by hand."""
        out = out or tmp_path / "out"
        out.mkdir(exist_ok=True)
        script = HERE / "clients" / f"{name}.py"
        if alone:
            command(HERE / "cuda_is_cpu.py", script, world.scene, world.model, out, *words, cwd=tmp_path)
        else:
            monkeypatch.chdir(tmp_path)
            monkeypatch.setattr(sys, "argv", [str(word) for word in (script, world.scene, world.model, out, *words)])
            with CudaIsCpu():
                runpy.run_path(str(script), run_name="__main__")
        return json.loads((out / "result.json").read_text())

    return run


@pytest.mark.slow
def test_the_loop_of_2024_trains_as_train_py_does_and_resumes(world, client, tmp_path):
    out = tmp_path / "out"
    words = (*TRAINING, "--checkpoint_iterations", 150)
    result = client("tutorial_loop", *words)
    assert fell(result["losses"], 0.8)
    assert abs(result["psnr"] - world.psnr) < 1.0
    assert result["count"] > 400 and result["exposures"] == [VIEWS - HELD_OUT, 3, 4] and result["exposure_moved"] == 0
    assert ply_count(out / "point_cloud" / f"iteration_{ITERATIONS}" / "point_cloud.ply") == result["count"]
    resumed = client("tutorial_loop", *words, "--start_checkpoint", out / "chkpnt150.pth", out=tmp_path / "resumed")
    assert len(resumed["losses"]) == 150 and abs(resumed["psnr"] - world.psnr) < 1.0
    # train.py goes on from what the loop wrote.
    start = "--start_checkpoint", out / "chkpnt150.pth"
    train_on(world.scene, tmp_path / "again", "--eval", "--iterations", 160, *start)


@pytest.mark.parametrize(
    "options",
    [
        ("--optimizer_type", "sparse_adam", "-d", "depths", "--antialiasing"),
        ("--train_test_exp", "-w"),
    ],
    ids=["depths", "train_test_exp"],
)
def test_the_loop_of_2024_takes_the_options_of_its_release(world, client, options):
    short = (*TRAINING, "--iterations", 120, "--opacity_reset_interval", 70)
    result = client("tutorial_loop", *short, *options)
    assert fell(result["losses"][:50], 0.95) and result["count"] > 300 and result["psnr"] > 6
    assert len(result["depth_losses"]) == (120 if "-d" in options else 0)
    if "-d" in options:
        assert fell(result["depth_losses"][:60])
    if "--train_test_exp" in options:
        assert result["exposures"] == [VIEWS, 3, 4] and result["exposure_moved"] > 1e-3


@pytest.mark.slow
def test_the_loop_of_2023_with_its_own_option_classes(world, client):
    result = client("tutorial_loop_2023", *TRAINING, "--port", 0, alone=True)
    assert fell(result["losses"], 0.8) and result["count"] > 400 and abs(result["psnr"] - world.psnr) < 1.5
