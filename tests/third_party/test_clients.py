"""Programs written for the reference's modules run on ours: clients/*.py, each in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from synthetic import FOCAL, HEIGHT, WIDTH, make_colmap_scene

pytest.importorskip("diff_gaussian_rasterization", reason="the extensions are not built: make test")

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
ITERATIONS = 300
DENSIFYING = ("--densify_from_iter", 50, "--densification_interval", 50, "--densify_until_iter", 260)
TRAINING = ("--eval", "--iterations", ITERATIONS, *DENSIFYING)
VIEWS, HELD_OUT = 17, 3


def command(*words: object, cwd: Path) -> None:
    """Run Python with these words in a folder."""
    places = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]  # packages may be installed there
    env = os.environ | {"PYTHONPATH": os.pathsep.join(places), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, *map(str, words)]
    done = subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        pytest.fail(f"exit status {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}", pytrace=False)


def ply_count(path: Path) -> int:
    return len(PlyData.read(path)["vertex"])


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(int)


def fell(losses: list[float], by: float = 0.98) -> bool:
    """Whether the last quarter of the losses is lower than the first, by this factor."""
    part = max(len(losses) // 4, 1)
    return sum(losses[-part:]) < by * sum(losses[:part])


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A scene with central principal point and depth maps, and the model that train.py made of it."""
    folder = tmp_path_factory.mktemp("clients")
    scene, model = folder / "scene", folder / "model"
    model_of_colmap = make_colmap_scene(scene, params=(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    scales = {}
    for image in model_of_colmap.images.values():
        name = os.path.splitext(image.name)[0]
        path = scene / "depths" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH), 20000, dtype=np.uint16)).save(path)
        scales[name] = {"scale": 1.0, "offset": 0.0}
    (scene / "sparse" / "0" / "depth_params.json").write_text(json.dumps(scales))
    train = ("train.py", "-s", scene, "-m", model, *TRAINING, "--checkpoint_iterations", ITERATIONS)
    command(*train, "--test_iterations", ITERATIONS, cwd=ROOT)
    psnr = json.loads((model / "train_log.json").read_text())[-1]["test_psnr"]
    return SimpleNamespace(scene=scene, model=model, psnr=psnr)


@pytest.fixture
def client(world: SimpleNamespace, tmp_path: Path):
    """Run a client in a folder that is not the project's; returns what it wrote as its result."""

    def run(name: str, *words: object, out: Path | None = None) -> Any:
        out = out or tmp_path / "out"
        out.mkdir(exist_ok=True)
        script = HERE / "clients" / f"{name}.py"
        command(HERE / "cuda_is_cpu.py", script, world.scene, world.model, out, *words, cwd=tmp_path)
        return json.loads((out / "result.json").read_text())

    return run


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
    command("train.py", "-s", world.scene, "-m", tmp_path / "again", "--eval", "--iterations", 160,
            "--start_checkpoint", out / "chkpnt150.pth", cwd=ROOT)  # fmt: skip


@pytest.mark.parametrize(
    "options",
    [
        ("--optimizer_type", "sparse_adam"),
        ("-d", "depths"),
        ("--train_test_exp",),
        ("-w", "--random_background", "--antialiasing"),
    ],
    ids=["sparse_adam", "depths", "train_test_exp", "background"],
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


def test_the_loop_of_2023_with_its_own_option_classes(world, client):
    result = client("tutorial_loop_2023", *TRAINING, "--port", 0)
    assert fell(result["losses"], 0.8) and result["count"] > 400 and abs(result["psnr"] - world.psnr) < 1.5


def test_distiller(world, client):
    result = client("distiller")
    assert result["first"] == ITERATIONS and fell(result["losses"], 0.95)
    assert result["moved"]["_xyz"] == result["moved"]["_rotation"] == 0
    assert result["moved"]["_features_rest"] > 0 and result["moved"]["_scaling"] > 0
    assert all(rate == pytest.approx(0.9**20) for rate in result["rates"].values())
    assert result["bands"] == [result["count"], 4, 3] and result["saved"] == 0
