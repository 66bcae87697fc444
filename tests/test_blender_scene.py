"""Blender folders: poses, angles, the start cloud, photos with alpha, and messages for faulty folders."""

import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from synthetic import FakeGaussians, edit_json, folder_state, options_of, read

from scene import Scene
from scene.dataset_readers import readNerfSyntheticInfo
from utils.system_utils import UserError

_read = partial(read, hold_out=True)


def _edit(scene: Path, change, name: str = "transforms_train.json") -> None:
    edit_json(scene / name, change)


def test_axes_of_a_hand_made_pose(blender_scene):
    # A camera at (0,-4,0) facing +y, z up. OpenGL's camera has x right, y up, z backward.
    pose = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
    _edit(blender_scene, lambda content: content["frames"][0].update(transform_matrix=pose))
    camera = _read(blender_scene).train_cameras[0]

    def seen(point):
        return camera.R.T @ point + camera.T

    np.testing.assert_allclose(seen(np.array([0, 0, 0])), [0, 0, 4], atol=1e-12)  # ahead
    np.testing.assert_allclose(seen(np.array([1, 0, 0])), [1, 0, 4], atol=1e-12)  # right
    np.testing.assert_allclose(seen(np.array([0, 0, 1])), [0, -1, 4], atol=1e-12)  # up is -y
    np.testing.assert_allclose(camera.center, [0, -4, 0], atol=1e-12)


def test_angles_follow_each_pictures_size(blender_scene):
    Image.new("RGBA", (50, 80)).save(blender_scene / "train" / "r_1.png")
    first, second = _read(blender_scene).train_cameras[:2]
    for camera, (width, height) in ((first, (40, 30)), (second, (50, 80))):
        focal = width / (2 * math.tan(0.35))
        assert camera.FovX == pytest.approx(0.7) and camera.FovY == pytest.approx(2 * math.atan(height / (2 * focal)))
        assert (camera.width, camera.height, camera.cx, camera.cy) == (width, height, width / 2, height / 2)


def test_order_names_and_hold_out(blender_scene):
    _edit(blender_scene, lambda content: content["frames"].reverse())
    info = _read(blender_scene)
    assert [c.image_name for c in info.train_cameras] == ["r_3", "r_2", "r_1", "r_0"]
    assert [c.image_name for c in info.test_cameras] == ["r_0", "r_1"]
    together = _read(blender_scene, hold_out=False)
    assert together.test_cameras == []
    assert [c.image_path.parent.name for c in together.train_cameras] == ["train"] * 4 + ["test"] * 2
    assert info.extent == pytest.approx(4.4)  # a circle of radius 4


def test_suffix_is_appended_only_when_missing(blender_scene):
    Image.new("RGB", (40, 30)).save(blender_scene / "train" / "dotted.7.jpg")

    def change(content):
        content["frames"][0]["file_path"] = "train/r_0.png"
        content["frames"][1]["file_path"] = "train/dotted.7"

    _edit(blender_scene, change)
    names = [(c.image_path.name, c.image_name) for c in _read(blender_scene).train_cameras]
    assert names[:3] == [("r_0.png", "r_0"), ("dotted.7.jpg", "dotted.7"), ("r_2.png", "r_2")]


def test_test_views_may_be_missing_without_eval(blender_scene, capsys):
    whole = read(blender_scene)
    for path in sorted((blender_scene / "test").iterdir()):
        path.unlink()
    with pytest.raises(UserError, match="photos that .* lists are missing: .*; put them there, .*or leave --eval out"):
        read(blender_scene, hold_out=True)
    train = [camera.image_name for camera in read(blender_scene).train_cameras]
    assert "transforms_test.json are not used for training: " in capsys.readouterr().err
    (blender_scene / "transforms_test.json").unlink()
    assert [camera.image_name for camera in read(blender_scene).train_cameras] == train
    assert len(train) == 4 < len(whole.train_cameras) and readNerfSyntheticInfo(blender_scene).train_cameras
    with pytest.raises(UserError, match="no transforms_test.json in .*, which --eval needs; .*leave --eval"):
        read(blender_scene, hold_out=True)


def test_no_photo_both_trains_and_tests(blender_scene, capsys):
    train = json.loads((blender_scene / "transforms_train.json").read_text())
    _edit(blender_scene, lambda test: test["frames"].append(train["frames"][1]), "transforms_test.json")
    info = read(blender_scene, hold_out=True)
    assert len(info.train_cameras) == 3 and len(info.test_cameras) == 3
    assert "1 photos of" in capsys.readouterr().err
    assert len(read(blender_scene).train_cameras) == 6
    (blender_scene / "transforms_test.json").write_text(json.dumps(train))
    with pytest.raises(UserError, match="all training photos of .* are test photos, too; .*leave --eval out"):
        read(blender_scene, hold_out=True)


def test_random_cloud(blender_scene):
    cloud = _read(blender_scene).point_cloud
    assert cloud.points.shape == (100_000, 3) and cloud.points.dtype == np.float32
    assert -1.3 <= cloud.points.min() < -1.299 and 1.299 < cloud.points.max() <= 1.3
    # The points are even: the mean of 100,000 uniform values of deviation 0.75 is within 0.012, five deviations.
    assert np.abs(cloud.points.mean(axis=0)).max() < 0.012
    assert (cloud.colors == np.float32(127 / 255)).all()


def test_scene_composites_and_leaves_the_dataset_alone(blender_scene, tmp_path):
    before = folder_state(blender_scene)
    scene = Scene(options_of(blender_scene, tmp_path / "out", eval=True), FakeGaussians(), shuffle=False)
    camera = scene.getTrainCameras()[1]
    white, black = camera.target(torch.ones(3)), camera.target(torch.zeros(3))
    assert white[:, 0, 0].tolist() == [1, 1, 1] and black[:, 0, 0].tolist() == [0, 0, 0]
    middle = torch.tensor([200, 40, 90]) / 255
    assert torch.equal(white[:, 15, 20], middle) and torch.equal(black[:, 15, 20], middle)
    assert camera.alpha_mask.shape == (1, 30, 40)
    assert folder_state(blender_scene) == before
    entries = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert [entry["img_name"] for entry in entries] == ["r_0", "r_1", "r_0", "r_1", "r_2", "r_3"]
    assert (entries[0]["width"], entries[0]["height"], entries[0]["fx"]) == (40, 30, entries[0]["fy"])


def _turned(change):
    """The scene with `change` of the 3x3 part of each pose, which gets the frame's index, too."""

    def edit(content):
        for index, frame in enumerate(content["frames"]):
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
            pose[:3, :3] = change(pose[:3, :3], index)
            frame["transform_matrix"] = pose.tolist()

    return lambda scene: _edit(scene, edit)


def test_a_scale_of_poses_is_divided_out(blender_scene):
    plain, factors = _read(blender_scene), [4.0, 0.25, 1.0, 1e-4]
    _turned(lambda turn, index: turn * factors[index])(blender_scene)
    scaled = _read(blender_scene)
    for one, other, factor in zip(plain.train_cameras, scaled.train_cameras, factors, strict=True):
        close = 1e-14 if factor == 1e-4 else 0
        np.testing.assert_allclose(other.R, one.R, rtol=close, atol=close)
        np.testing.assert_allclose(other.T, one.T, rtol=close, atol=close)
    assert scaled.extent == pytest.approx(plain.extent, rel=1e-14)


def test_real_scene(shared_dir, tmp_path):
    folder = shared_dir / "scenes" / "nerf_lego200_tiny"
    scene = Scene(options_of(folder, tmp_path / "out", eval=True, white_background=True), FakeGaussians())
    assert (len(scene.getTrainCameras()), len(scene.getTestCameras())) == (100, 25)
    target = scene.getTestCameras()[0].target(torch.ones(3))
    assert target.shape == (3, 200, 200) and target.max() == 1 and target.mean() > 0.5
