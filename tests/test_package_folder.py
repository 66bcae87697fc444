"""A copy of the code as a folder of another project: its modules by two names, and a `utils` folder beside ours."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("arguments", "gaussian_renderer", "groundwork", "lpipsPyTorch", "scene", "splatting", "utils")

# Trains two steps and renders, by the names under gaussian_splatting, by the plain ones, and by both mixed.
SCRIPT = """
import argparse
import torch
from gaussian_splatting.arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_splatting.gaussian_renderer import render
from gaussian_splatting.lpipsPyTorch import lpips
from gaussian_splatting.scene.cameras import MiniCam
from gaussian_splatting.scene.gaussian_model import GaussianModel
from gaussian_splatting.utils.graphics_utils import BasicPointCloud
from gaussian_splatting.utils.loss_utils import l1_loss, ssim
from gaussian_splatting.utils.sh_utils import RGB2SH
import arguments, gaussian_renderer, scene.gaussian_model, scene.cameras, utils.loss_utils

assert GaussianModel.__module__ == "gaussian_splatting.scene.gaussian_model"
parser = argparse.ArgumentParser()
groups = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
_, opt, pipe = (group.extract(parser.parse_args([])) for group in groups)
points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)).numpy() + [-0.5, -0.5, 2]
cloud = BasicPointCloud(points.astype("float32"), 0 * points.astype("float32") + 0.7, 0 * points.astype("float32"))
projection = torch.tensor([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])

images = []
for model_of in (GaussianModel, scene.gaussian_model.GaussianModel):
    for camera_of, draw in ((MiniCam, gaussian_renderer.render), (scene.cameras.MiniCam, render)):
        camera = camera_of(24, 20, 0.9, 0.9, 0.01, 100.0, torch.eye(4), projection)
        gaussians = model_of(3)
        gaussians.create_from_pcd(cloud, [], 1.0)
        gaussians.training_setup(opt)
        for _ in range(2):
            image = draw(camera, gaussians, pipe, torch.zeros(3))["render"]
            (l1_loss(image, torch.ones_like(image)) - utils.loss_utils.ssim(image, torch.ones_like(image))).backward()
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad()
        images.append(image.detach())
assert images[0].any() and all(torch.equal(image, images[0]) for image in images[1:])
assert ssim(image, image.detach()) == 1
print("done")
"""


def run(script: str, path: list[Path], folder: Path) -> str:
    """Run a script in a folder with `path` in front of the places that modules come from."""
    places = [*map(str, path), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places))}
    done = subprocess.run([sys.executable, "-B", "-c", script], cwd=folder, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_package_folder_works_beside_the_plain_names(tmp_path):
    """Some projects keep the code in a sub-folder and have both folders on the path of imports."""
    package = tmp_path / "project" / "gaussian_splatting"
    for room in ROOMS:
        shutil.copytree(ROOT / room, package / room, ignore=shutil.ignore_patterns("__pycache__"))
    assert run(SCRIPT, [package.parent, package], tmp_path).endswith("done\n")


@pytest.mark.slow
def test_utils_merges_with_a_folder_of_that_name(tmp_path):
    """`utils` has no __init__.py, so a project's own `utils` without one adds its modules, on either side of ours."""
    assert not (ROOT / "utils" / "__init__.py").exists()
    (tmp_path / "utils").mkdir()
    (tmp_path / "utils" / "pose_utils.py").write_text("from utils.sh_utils import C0\nfrom utils import image_utils\n")
    script = """
import utils.pose_utils
from utils.general_utils import PILtoTorch
from groundwork.host.machine import compute_device
assert utils.pose_utils.C0 > 0 and len(utils.__path__) >= 2
print("done")
"""
    assert run(script, [tmp_path, ROOT], tmp_path) == "done\n"
    assert run(script, [ROOT, tmp_path], ROOT) == "done\n"
