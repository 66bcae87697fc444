"""Photos of distorting lenses as they are, the default, through train.py, render.py and metrics.py."""

import json
import sys

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.scene import scene_arguments
from PIL import Image
from synthetic import BROWN, CENTER, HEIGHT, WIDTH, FakeGaussians, make_colmap_scene, options_of, read

import metrics
import render
import train
from gaussian_renderer import rasterizer_settings
from gaussian_renderer.camera_paths.poses import poses_of
from scene import Scene
from scene.checks.scene import check_dataset
from scene.images.lens import Lens, pinhole_of
from scene.readers.start_cloud import random_in_frusta
from utils.system_utils import UserError

PANORAMA = ("EQUIRECTANGULAR", (WIDTH, HEIGHT))
FISHEYE = (40.0, 40.0, *CENTER, 0.05, -0.01, 0.003, -0.001)


@pytest.mark.parametrize(
    ("model", "params", "resolution"), [("OPENCV", BROWN, 1), ("OPENCV_FISHEYE", FISHEYE, 2), (*PANORAMA, 2)]
)
def test_views_show_points_where_the_photo_has_them(tmp_path, model, params, resolution):
    reconstruction = make_colmap_scene(tmp_path / "scene", model=model, params=params, views=3)
    options = options_of(tmp_path / "scene", tmp_path / "out", lenses="native", resolution=resolution)
    scene = Scene(options, FakeGaussians(), shuffle=False)
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    count = len(points)
    values = Gaussians(
        torch.from_numpy(points), torch.ones(count, 1), torch.full((count, 3), -4.0), torch.ones(count, 4),
        colors=torch.ones(count, 3),
    )  # fmt: skip
    pipe = type("Pipe", (), {"debug": False})
    for camera in scene.getTrainCameras():
        assert (camera.image_width, camera.image_height) == (WIDTH // resolution, HEIGHT // resolution)
        settings = rasterizer_settings(camera, type("Model", (), {"active_sh_degree": 0}), pipe, torch.zeros(3))
        doubles = Gaussians(*(None if value is None else value.double() for value in values))
        splats, _, _, counts, *_ = OPERATORS.project(*scene_arguments(doubles, settings, True))
        image = reconstruction.find_image_with_name(camera.image_name)
        shown = [index for index in range(count) if counts[index] and image.project_point(points[index]) is not None]
        assert len(shown) > 20
        theirs = np.array([image.project_point(points[index]) for index in shown]) / resolution - 0.5
        assert np.abs(splats[shown, :2].numpy() - theirs).max() < 1e-4  # matrices are float32


def test_points_of_panoramas(tmp_path):
    make_colmap_scene(tmp_path / "scene", model=PANORAMA[0], params=PANORAMA[1])
    said = check_dataset(str(tmp_path / "scene"), "images")
    assert not [line for line in said if "of the points are in no photo" in line.text or "other photos" in line.text]
    scene = Scene(options_of(tmp_path / "scene", tmp_path / "out", lenses="native"), FakeGaussians())
    assert poses_of(scene.getTrainCameras()).fov == pytest.approx(60)  # what shows all is stretched
    view = read(tmp_path / "scene", native=True).train_cameras[0]
    local = (random_in_frusta([view]).points - view.center) @ view.R
    assert (local < 0).mean(axis=0) == pytest.approx([0.5] * 3, abs=0.01)  # all around, not in front alone


def test_known_models_need_no_pycolmap(tmp_path, monkeypatch):
    make_colmap_scene(tmp_path, model="OPENCV", params=BROWN, views=2)
    monkeypatch.setattr("scene.images.lens.import_pycolmap", lambda: pytest.fail("pycolmap is imported"))
    assert all(view.native for view in read(tmp_path, native=True).train_cameras)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "params"), [("OPENCV_FISHEYE", FISHEYE), PANORAMA])
def test_a_training_and_its_renders_have_the_photos(tmp_path, monkeypatch, model, params):
    scene, out = tmp_path / "scene", tmp_path / "out"
    make_colmap_scene(scene, model=model, params=params, views=17)
    words = ["-s", str(scene), "-m", str(out), "--eval", "--iterations", "60", "--densify_from_iter", "1000"]
    train.main([*words, "--checkpoint_iterations", "30"])
    assert json.loads((out / "model.json").read_text())["lenses"] == "native"
    ply = out / "point_cloud/iteration_60/point_cloud.ply"
    once = ply.read_bytes()
    ply.unlink()
    words += ["--start_checkpoint", str(out / "chkpnt30.pth")]
    train.main(words)
    assert ply.read_bytes() == once
    monkeypatch.setattr(sys, "argv", ["render.py", "-m", str(out), "--skip_train"])
    render.main()
    monkeypatch.setattr(sys, "argv", ["metrics.py", "-m", str(out)])
    metrics.main()
    for path in (out / "test/ours_60/renders").iterdir():
        with Image.open(path) as image:
            assert image.size == (WIDTH, HEIGHT)
    photos = [np.asarray(Image.open(photo).convert("RGB")) for photo in (scene / "images").rglob("*.png")]
    for path in (out / "test/ours_60/gt").iterdir():  # the photo itself, not a resampled one
        with Image.open(path) as image:
            shown = np.asarray(image.convert("RGB"))
        assert any(np.array_equal(shown, photo) for photo in photos)
    with pytest.raises(UserError, match="was trained on the photos as they are; leave --lenses undistort out"):
        train.main([*words, "--lenses", "undistort"])


def test_a_model_of_undistorted_photos_goes_on_with_them(tmp_path, capsys):
    """Also one of the time when that was the default, whose record does not say so."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    make_colmap_scene(scene, model="OPENCV", params=BROWN, views=5)
    words = ["-s", str(scene), "-m", str(out), "--iterations", "20"]
    train.main([*words, "--lenses", "undistort", "--checkpoint_iterations", "10"])
    ply, model = out / "point_cloud/iteration_20/point_cloud.ply", out / "model.json"
    once, record = ply.read_bytes(), json.loads(model.read_text())
    assert record.pop("lenses") == "undistort"
    model.write_text(json.dumps(record))
    words += ["--start_checkpoint", str(out / "chkpnt10.pth")]
    capsys.readouterr()
    train.main(words)
    assert ply.read_bytes() == once and "lenses" not in json.loads(model.read_text())
    assert "--lenses" not in capsys.readouterr().err
    with pytest.raises(UserError, match="was trained on undistorted photos; leave --lenses native out"):
        train.main([*words, "--lenses", "native"])


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV", (500, 500, 320, 240, -0.3, 0.1, 1e-3, 1e-3)),
        ("SIMPLE_RADIAL", (300, 320, 240, -0.2)),
        ("FULL_OPENCV", (500, 500, 320, 240, 0.8, 0.2, 0, 0, 0.01, 1.1, 0.4, 0.05)),
        ("OPENCV_FISHEYE", (120, 120, 320, 240, -0.05, 0.01, -0.006, 0.001)),
        ("OPENCV_FISHEYE", (60, 60, 320, 240, 0, -0.02, 0, 0)),  # a whole picture within the photo
        ("FOV", (500, 500, 320, 240, 0.9)),
        ("EUCM", (250, 250, 320, 240, 0.6, 1.1)),
        ("SIMPLE_FISHEYE", (150, 320, 240)),
    ],
)
def test_distortions_of_real_lenses_are_taken(model, params):
    assert pinhole_of(Lens(model, tuple(map(float, params)), 640, 480), "a.png") is None


SHORT = ("OPENCV_FISHEYE", (12.0, 12.0, *CENTER, 0, 0, 0, 0))


@pytest.mark.parametrize(
    ("lens", "words", "size"),
    [(SHORT, ("-r", 4), "24 x 16"), (SHORT, ("--time_budget", 9), "48 x 32"), (PANORAMA, ("-r", 4), "24 x 16")],
)  # fmt: skip
def test_rays_that_are_not_there_leave_a_finished_model_as_it_was(tmp_path, lens, words, size):
    make_colmap_scene(tmp_path / "scene", model=lens[0], params=lens[1], views=3)
    given = ["-s", tmp_path / "scene", "-m", tmp_path / "out", "--iterations", 1, "--disable_viewer", "--quiet"]
    train.main([*map(str, given)])
    before = {file: file.read_bytes() for file in (tmp_path / "out").rglob("*") if file.is_file()}
    with pytest.raises(UserError, match=f"cannot be rendered at {size} pixels, as projection='ray' needs tiles"):
        train.main([*map(str, (*given, "--projection", "ray", *words))])
    assert before == {file: file.read_bytes() for file in (tmp_path / "out").rglob("*") if file.is_file()}
