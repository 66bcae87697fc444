"""Scene as other people's code calls it: with their options, their readers, and their own package `arguments`."""

import json
import os
import subprocess
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from reference_records import CameraOf2024
from synthetic import FakeGaussians, options_of

import scene as scene_package
import train
from groundwork.files.json_files import OFFSET
from scene import Scene
from scene.dataset_readers import read_scene, sceneLoadTypeCallbacks
from utils.system_utils import UserError

ROOT = Path(__file__).resolve().parents[1]
OF_2023 = {"sh_degree": 3, "images": "images", "resolution": -1, "white_background": False, "data_device": "cuda",
           "eval": True}  # fmt: skip
OF_2024 = {**OF_2023, "depths": "", "train_test_exp": False}


def _args(folder: Path, out: Path, values: dict[str, object] = OF_2024, **changes: object) -> SimpleNamespace:
    return SimpleNamespace(source_path=str(folder), model_path=str(out), **{**values, **changes})


@pytest.mark.parametrize("values", [OF_2023, OF_2024])
def test_options_of_the_reference_suffice(colmap_scene, tmp_path, values):
    gaussians = FakeGaussians()
    made = Scene(_args(colmap_scene, tmp_path / "out", values), gaussians)
    ours = Scene(options_of(colmap_scene, tmp_path / "o", eval=True), FakeGaussians())
    names = [camera.image_name for camera in made.getTrainCameras()]
    assert names == [camera.image_name for camera in ours.getTrainCameras()] and len(names) == 14
    assert len(made.getTestCameras()) == 3 and made.images.limit == 0
    for name in ("cameras.json", "input.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "o" / name).read_bytes()
    assert gaussians.extent == made.cameras_extent == ours.cameras_extent


def test_lists_of_cameras_may_be_replaced(colmap_scene, tmp_path):
    made = Scene(_args(colmap_scene, tmp_path / "out"), FakeGaussians(), resolution_scales=[1.0, 2.0])
    assert made.train_cameras.keys() == made.test_cameras.keys() == {1.0, 2.0}
    assert made.getTrainCameras(2.0) is made.train_cameras[2.0] and made.train_cameras[2.0][0].image_width == 48
    few, others = made.train_cameras[1.0][:2], [object()]
    made.train_cameras[1.0], made.test_cameras = few, {1.0: others}
    assert made.getTrainCameras() is few and made.getTestCameras() is others


def test_a_readers_replacement_gets_the_references_arguments(colmap_scene, blender_scene, tmp_path, monkeypatch):
    calls = []
    known = read_scene(colmap_scene, "images", True)

    def theirs(*given):
        calls.append(given)
        return replace(known, test_cameras=known.test_cameras[:1])

    assert scene_package.sceneLoadTypeCallbacks is sceneLoadTypeCallbacks
    monkeypatch.setitem(sceneLoadTypeCallbacks, "Colmap", theirs)
    args = _args(colmap_scene, tmp_path / "out", images="photos", depths="d", train_test_exp=True)
    made = Scene(args, FakeGaussians(), start=False)
    assert calls == [(str(colmap_scene), "photos", "d", True, True)]
    assert (len(made.getTrainCameras()), len(made.getTestCameras())) == (14, 1)
    assert made.cameras_extent == known.extent
    monkeypatch.setitem(sceneLoadTypeCallbacks, "Blender", theirs)
    Scene(_args(blender_scene, tmp_path / "out", OF_2023, white_background=True), FakeGaussians(), start=False)
    assert calls[1:] == [(str(blender_scene), True, "", True)]


TheirInfo2023 = namedtuple(
    "TheirInfo2023", ("point_cloud", "train_cameras", "test_cameras", "nerf_normalization", "ply_path")
)


def test_a_replaced_reader_may_return_records_of_its_own(colmap_scene, tmp_path, monkeypatch):
    known = read_scene(colmap_scene, "images", True)
    lists = [[CameraOf2024(*camera) for camera in part] for part in (known.train_cameras, known.test_cameras)]
    ply = tmp_path / "points.ply"
    ply.write_bytes(b"ply")
    theirs = TheirInfo2023(known.point_cloud, *lists, {"translate": np.zeros(3), "radius": 3.5}, str(ply))
    monkeypatch.setitem(sceneLoadTypeCallbacks, "Colmap", lambda *_: theirs)
    made = Scene(_args(colmap_scene, tmp_path / "out"), FakeGaussians())
    assert made.cameras_extent == 3.5 and made.gaussians.world_offset == (0, 0, 0)
    assert (tmp_path / "out" / "input.ply").read_bytes() == b"ply"
    ours = Scene(_args(colmap_scene, tmp_path / "o"), FakeGaussians())
    assert made.training_pixels() == ours.training_pixels()
    train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "trained"), "--iterations", "2", "-r", "24", "--eval",
                "--test_iterations", "2"])  # fmt: skip
    assert (tmp_path / "trained" / "point_cloud" / "iteration_2" / "point_cloud.ply").is_file()


class TheirModel:
    """The reference's class, as a scene with exposures calls it."""

    exposure_mapping = {"a.png": 0}

    def create_from_pcd(self, pcd, cam_infos, spatial_lr_scale) -> None:
        self.calls = []

    def get_exposure_from_name(self, image_name: str) -> torch.Tensor:
        return torch.nn.Parameter(torch.eye(3, 4))

    def save_ply(self, path: str) -> None:
        FakeGaussians().save_ply(path)

    def load_ply(self, path: str, use_train_test_exp: bool = False) -> None:
        self.calls = [use_train_test_exp]


def test_a_foreign_model_is_saved_and_loaded_with_exposures(colmap_scene, tmp_path):
    for halves in (True, False):
        args = _args(colmap_scene, tmp_path / str(halves), train_test_exp=halves)
        Scene(args, TheirModel()).save(1)
        model = TheirModel()
        Scene(args, model, load_iteration=1)
        assert model.calls == [halves] and (tmp_path / str(halves) / "exposure.json").is_file() == halves
    table = json.loads((tmp_path / "True" / "exposure.json").read_text())
    assert table == {"a.png": torch.eye(3, 4).tolist()}


def _run(code: str, folder: Path) -> None:
    """Run code in a folder whose packages are found before ours."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_package_of_options_of_their_own_does_not_matter(colmap_scene, tmp_path):
    (tmp_path / "arguments").mkdir()
    (tmp_path / "arguments" / "__init__.py").write_text("class ModelParams:\n    theirs = True\n")
    values = dict(vars(_args(colmap_scene, tmp_path / "out")), resolution=24)
    _run(
        f"""
from types import SimpleNamespace
import gaussian_renderer, scene.export_world, scene.saved_model, utils.camera_utils
from scene import GaussianModel, ModelParams, Scene, sceneLoadTypeCallbacks
import arguments
assert ModelParams is arguments.ModelParams and ModelParams.theirs
scene = Scene(SimpleNamespace(**{values!r}), GaussianModel(3))
assert len(scene.getTrainCameras()) == 14
scene.save(1)
Scene(SimpleNamespace(**{values!r}), GaussianModel(3), load_iteration=-1)
""",
        tmp_path,
    )
    (tmp_path / "arguments" / "__init__.py").write_text("raise ModuleNotFoundError('gone', name='arguments')")
    _run("import scene; assert not hasattr(scene, 'ModelParams') and scene.Scene", tmp_path)


@pytest.mark.parametrize(
    ("entry", "fault"),
    [
        (f'"{OFFSET}": [1, 2]', "world_offset must be three numbers"),
        ('"enlargement": 1e300', r"enlargement must be a number above 0, to 1e\+15, got 1e\+300"),
    ],
)
def test_a_broken_model_json_is_refused_when_a_model_is_loaded(colmap_scene, tmp_path, entry, fault):
    args = _args(colmap_scene, tmp_path / "out")
    Scene(args, FakeGaussians()).save(1)
    (tmp_path / "out" / "model.json").write_text(f"{{{entry}}}")
    with pytest.raises(UserError, match=f"model.json: {fault}"):
        Scene(args, FakeGaussians(), load_iteration=1)
