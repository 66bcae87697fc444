"""Scenes in a small unit: where they are drawn they are enlarged, and everything else has their own unit."""

import argparse
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from scaled_scene import scaled_scene
from strategies import begun
from synthetic import make_colmap_scene

import render
import train
from applications.doctor.model import check_model
from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import draw
from gaussian_renderer import render as render_view
from scene import Scene
from scene.checks.scene import check_dataset
from scene.dataset_readers import read_scene
from scene.gaussian_model import GaussianModel
from scene.poses import moved
from scene.readers.info import NEAREST
from scene.readers.tracks import enlargement
from scene.reprojection import twist_gradient
from scene.splats.reading import read_splats
from scene.with_splats import load_file, splats_of
from splatting.schedule import Schedule
from utils.graphics_utils import world_to_camera

FACTOR = 2.0**-10  # exact in float32, so that all differences come from constants of the unit
SMALL = ["-r", "48", "--test_iterations", "-1", "--no_curve", "--eval"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Path, Path]:
    """A scene, and the same in a small unit."""
    folder = tmp_path_factory.mktemp("scenes")
    make_colmap_scene(folder / "usual")
    return folder / "usual", scaled_scene(folder / "usual", FACTOR, folder / "small")


@pytest.fixture(scope="module")
def models(scenes, tmp_path_factory) -> tuple[Path, Path]:
    """The models of both scenes."""
    outs = tuple(tmp_path_factory.mktemp("models") / scene.name for scene in scenes)
    for scene, out in zip(scenes, outs, strict=True):
        _train(scene, out, "--save_iterations", 20, 30, "--checkpoint_iterations", 10)
    return outs


def _train(scene: Path, out: Path, *more: object, iterations: int = 30) -> np.ndarray:
    """Train, and return the vertices of the PLY."""
    train.main(["-s", str(scene), "-m", str(out), "--iterations", str(iterations), *SMALL, *map(str, more)])
    return PlyData.read(_ply(out, iterations))["vertex"].data


def _ply(out: Path, iterations: int = 30) -> Path:
    return out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply"


def _loss(out: Path) -> float:
    return json.loads((out / "train_log.json").read_text())[-1]["loss"]


def _positions(vertices: np.ndarray) -> np.ndarray:
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


def test_which_scenes_are_enlarged(scenes, tmp_path):
    """The enlarged one has the depths of usual scenes."""
    assert enlargement(read_scene(scenes[0], "images", hold_out=False)) == 1
    for number, factor in enumerate((1 / 5, 1.0, 1000.0)):
        info = read_scene(scaled_scene(scenes[0], factor, tmp_path / f"{number}"), "images", hold_out=False)
        assert enlargement(info) == 1
    for number, factor in enumerate((1 / 30, 1 / 100, 1e-4)):
        info = read_scene(scaled_scene(scenes[0], factor, tmp_path / f"small{number}"), "images", hold_out=False)
        found = enlargement(info)
        assert np.log2(found) % 1 == 0
        depths = np.concatenate([(info.point_cloud.points @ v.R + v.T)[:, 2] for v in info.train_cameras])
        # All points in front count here, those out of view, too.
        assert 9 * NEAREST < found * np.quantile(depths, 0.01) < 22 * NEAREST
    cloud = info.point_cloud._replace(points=np.full((4, 3), np.nan))
    assert enlargement(info._replace(point_cloud=cloud)) == enlargement(info._replace(point_cloud=None)) == 1


OPTIONS = [
    [],
    ["--strategy", "mcmc", "--max_num_splats", 400],
    ["--sparse_depth", 0.3],
    ["--refine_poses", "--sparse_depth", 0.3],
    ["--projection", "ray"],
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "".join(map(str, options)) or "default")
def test_a_small_unit_changes_no_training(scenes, tmp_path, options, capsys):
    """With starts of one size, rounding alone differs: with those of another unit, the loss is 4 to 20 % off."""
    usual, small = (_train(scene, tmp_path / scene.name, *options) for scene in scenes)
    assert "files keep the scene's unit" in capsys.readouterr().out
    assert len(usual) == len(small)
    assert _loss(tmp_path / "small") == pytest.approx(_loss(tmp_path / "usual"), rel=2e-3)
    far = np.abs(_positions(small) / FACTOR - _positions(usual)).max()
    assert far < 0.01 * np.abs(_positions(usual)).max()
    scales = [np.median(rows["scale_0"]) for rows in (usual, small)]
    assert scales[1] - np.log(FACTOR) == pytest.approx(scales[0], abs=0.01)


def test_noise_and_penalty_of_mcmc(scenes, tmp_path):
    """Both are those of the scene in a unit of which the enlarged one is a part."""
    opt = OptimizationParams(argparse.ArgumentParser()).extract(argparse.Namespace())
    moves, penalties, sizes = [], [], []
    for scene in scenes:
        gaussians = Scene(_options(scene, tmp_path), GaussianModel(0), shuffle=False, start=False).gaussians
        cloud = read_scene(scene, "images", hold_out=False)
        gaussians.create_from_pcd(cloud.point_cloud, cloud.train_cameras, cloud.extent)
        gaussians.training_setup(opt)
        gaussians._opacity.data.fill_(-5)
        before, control = gaussians._xyz.detach().clone(), begun("mcmc", gaussians, opt, Schedule(opt.iterations))
        control.after_step(SimpleNamespace(iteration=1, changes=False, density=control.actions(1)))
        moves.append((gaussians._xyz.detach() - before) / cloud.extent)
        penalties.append(control.penalty.scale * gaussians.get_scaling.mean().item())
        sizes.append(gaussians.enlargement * cloud.extent)
    larger = sizes[1] / sizes[0]
    assert moves[0].abs().max() > 1e-9
    torch.testing.assert_close(moves[1], moves[0] * larger**2, rtol=0.01, atol=1e-3 * float(moves[0].abs().max()))
    assert penalties[1] == pytest.approx(larger * penalties[0], rel=1e-3)


def test_refined_poses_are_in_the_scenes_own_unit(scenes, tmp_path):
    """The image pulls as strongly against the tracks."""
    for scene in scenes:
        _train(scene, tmp_path / scene.name, "--refine_poses", iterations=120)
    given = np.array([view.T for view in read_scene(scenes[0], "images", hold_out=True).train_cameras])
    usual, small = ([np.array(pose["T"]) for pose in _poses(tmp_path / scene.name)] for scene in scenes)
    change = np.abs(np.array(usual) - given).max()
    assert change > 1e-5
    assert np.abs(np.array(small) / FACTOR - np.array(usual)).max() < 0.05 * change


def _poses(out: Path) -> list:
    return json.loads((out / "poses.json").read_text())["train"]


def test_files_have_the_scenes_own_unit(models, monkeypatch):
    for out in models:
        monkeypatch.setattr(sys, "argv", ["render.py", "-m", str(out), "--skip_train", "--depth"])
        render.main()
    usual, small = models
    centers = [
        [entry["position"] for entry in json.loads((out / "cameras.json").read_text())] for out in (usual, small)
    ]
    np.testing.assert_allclose(np.array(centers[1]) / FACTOR, centers[0], rtol=1e-5, atol=1e-5)
    record = json.loads((small / "model.json").read_text())
    assert record["enlargement"] * FACTOR in (0.5, 1, 2)
    assert "enlargement" not in json.loads((usual / "model.json").read_text())
    assert f"comment enlargement {record['enlargement']}\n".encode() in _ply(small).read_bytes()
    assert b"comment enlargement" not in _ply(usual).read_bytes()
    for folder in ("renders", "depth"):
        pairs = zip(*(sorted((out / "test" / "ours_30" / folder).glob("*.png")) for out in (usual, small)), strict=True)
        for one, other in pairs:
            images = [np.asarray(Image.open(path), dtype=float) for path in (one, other)]
            assert np.abs(images[0] - images[1]).mean() < 0.005 * images[0].max()


def test_a_resumed_training_ends_with_the_bytes_of_one_that_was_not_stopped(scenes, models, tmp_path):
    _train(scenes[1], tmp_path, "--start_checkpoint", models[1] / "chkpnt10.pth")
    assert _ply(models[1]).read_bytes() == _ply(tmp_path).read_bytes()


def test_a_file_keeps_the_enlargement_of_its_training(scenes, models, tmp_path):
    ply = _ply(models[1])
    splats = read_splats(ply)
    assert splats.enlargement == json.loads((models[1] / "model.json").read_text())["enlargement"]
    scene = load_file(_options(scenes[1], models[1]), str(ply), argparse.Namespace(antialiasing=False))
    assert splats_of(scene.gaussians).enlargement == splats.enlargement
    _train(scenes[1], tmp_path / "next", "--init_ply", ply)
    assert json.loads((tmp_path / "next/model.json").read_text())["enlargement"] == splats.enlargement


def _options(scene: Path, out: Path) -> argparse.Namespace:
    given = argparse.Namespace(source_path=str(scene), model_path=str(out))
    return ModelParams(argparse.ArgumentParser()).extract(given)


def test_doctor_finds_no_fault_in_the_unit(scenes, tmp_path):
    _train(scenes[1], tmp_path / "out", iterations=300)
    said = [
        str(line.text) for line in [*check_dataset(str(scenes[1]), "images"), *check_model(str(tmp_path / "out"), -1)]
    ]
    assert any("on are drawn" in text for text in said)
    plain = [line.text for line in check_dataset(str(scenes[0]), "images") if line.is_problem]
    assert [line.text for line in check_dataset(str(scenes[1]), "images") if line.is_problem] == plain


def test_gradients_of_poses_and_depths(scenes):
    """Against autograd through the camera's matrices, which takes another way."""
    scene = Scene(_options(scenes[1], scenes[1].parent / "none"), GaussianModel(0), shuffle=False, start=False)
    gaussians, camera = scene.gaussians, scene.getTrainCameras()[3]
    scene.create_gaussians()
    pipe, black = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace()), torch.zeros(3)
    twist, unit = torch.zeros(6, dtype=torch.float64, requires_grad=True), scene.cameras_extent
    scale = torch.tensor([1.0] * 3 + [unit] * 3, dtype=torch.float64)
    package = render_view(moved(camera, twist * scale), gaussians, pipe, black)
    weights = torch.linspace(0, 1, package["render"].numel()).view_as(package["render"])
    (package["render"] * weights).sum().backward()
    numbers = draw(camera, gaussians, pipe, black).camera_gradient(weights * (package["render"] > 0), None).numpy()[:15]
    by_numbers = numbers * np.repeat((gaussians.enlargement, 1.0), (12, 3))
    found = twist_gradient(world_to_camera(camera.R, camera.T), by_numbers, unit)
    np.testing.assert_allclose(found, twist.grad.numpy(), rtol=1e-3, atol=1e-3 * np.abs(found).max())
