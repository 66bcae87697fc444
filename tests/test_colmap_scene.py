"""COLMAP folders from end to end: from files to views, cloud, extent and side files; messages for faulty folders."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from synthetic import CENTER, FOCAL, FakeGaussians, as_text, folder_state, make_colmap_scene, options_of, read

from scene import Scene
from scene.dataset_readers import scene_extent
from scene.images.store import image_device
from scene.readers.colmap import find_model, read_model
from scene.readers.depth_maps import Metric
from scene.readers.depth_scale import make_depth_params, make_metric_scale
from scene.readers.point_cloud import read_point_cloud, write_point_cloud
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

CLOUD = BasicPointCloud(np.eye(3), np.eye(3), np.zeros((3, 3)))


def _assert_same(a, b) -> None:
    assert len(a.train_cameras) == len(b.train_cameras) > 0
    for one, other in zip(a.train_cameras, b.train_cameras, strict=True):
        for name in ("image_name", "uid", "width", "height", "fx", "fy", "cx", "cy", "R", "T"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(a.point_cloud.points, b.point_cloud.points)
    np.testing.assert_array_equal(a.point_cloud.colors, b.point_cloud.colors)


def test_values_are_the_models(colmap_scene):
    reconstruction = pycolmap.Reconstruction(str(colmap_scene / "sparse" / "0"))
    info = read(colmap_scene)
    names = [camera.image_name for camera in info.train_cameras]
    assert names == sorted((image.name for image in reconstruction.images.values()), key=os.fsencode)
    assert names[0].startswith("Right/V") and names[-1].startswith("left/v")
    for camera in info.train_cameras:
        pose = reconstruction.find_image_with_name(camera.image_name).cam_from_world().matrix()
        np.testing.assert_array_equal(np.column_stack([camera.R.T, camera.T]), pose)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FOCAL, FOCAL, *CENTER)
        assert camera.image_path == colmap_scene / "images" / camera.image_name
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    cloud = info.point_cloud
    assert cloud.points.dtype == cloud.colors.dtype == np.float32
    np.testing.assert_array_equal(cloud.points, np.float32([point.xyz for point in points]))
    np.testing.assert_array_equal(cloud.colors, np.float32([point.color for point in points]) / 255)


def test_the_three_classic_files_and_sparse_itself_suffice(colmap_scene):
    whole = read(colmap_scene)
    sparse = colmap_scene / "sparse"
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        shutil.move(sparse / "0" / name, sparse / name)
    shutil.rmtree(sparse / "0")
    _assert_same(read(colmap_scene), whole)


@pytest.mark.parametrize("text", [[], ["cameras"], ["images", "points3D"], ["cameras", "images"]])
def test_a_model_may_have_files_of_both_kinds(colmap_scene, text):
    """A broken binary file falls back to text, too."""
    whole = read(colmap_scene)
    sparse = colmap_scene / "sparse" / "0"
    pycolmap.Reconstruction(str(sparse)).write_text(str(sparse))
    for name in ("cameras", "images", "points3D") if text else ():
        (sparse / f"{name}.{'bin' if name in text else 'txt'}").unlink()
    if not text:
        (sparse / "cameras.bin").write_bytes((sparse / "cameras.bin").read_bytes()[:-5])
    _assert_same(read(colmap_scene), whole)


@pytest.mark.parametrize("start", [{"init_type": "random"}, {"init_pcd_path": "cloud.ply"}, {"init_pcd_path": CLOUD}])
def test_a_model_may_have_no_points(colmap_scene, start):
    sparse = colmap_scene / "sparse" / "0"
    (sparse / "points3D.bin").unlink()
    with pytest.raises(UserError, match="has no points; start from random points with --init_type random, or from a"):
        read(colmap_scene)
    write_point_cloud(colmap_scene / "cloud.ply", CLOUD.points, 255 * CLOUD.colors)
    if start.get("init_pcd_path") == "cloud.ply":
        start = {"init_pcd_path": str(colmap_scene / "cloud.ply")}
    assert len(read(colmap_scene, **start).point_cloud.points) in (3, 100_000)
    (colmap_scene / "cloud.ply").rename(sparse / "points3D.ply")
    info = read(colmap_scene)
    np.testing.assert_array_equal(info.point_cloud.points, CLOUD.points)
    assert info.ply_path == sparse / "points3D.ply"
    (sparse / "points3D.txt").write_text("# none\n")
    assert read(colmap_scene).ply_path == sparse / "points3D.ply"  # although it is older


@pytest.mark.parametrize("metric", [False, True])
def test_maps_without_2d_points_have_one_reason_and_one_way_out(colmap_scene, metric):
    as_text(colmap_scene)
    path = colmap_scene / "sparse" / "0" / "images.txt"
    rows = [line for line in path.read_text().split("\n") if not line.startswith("#")]
    path.write_text("".join(f"{line}\n\n" for line in rows[::2] if line))
    depths = colmap_scene / "depths"
    for view in read(colmap_scene).train_cameras:
        (depths / view.image_name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((view.height, view.width), 100, np.uint8)).save(depths / view.image_name)
    said = "at 0 points of .* too few" if metric else "can be fitted: .* see 0 points at most"
    with pytest.raises(UserError, match=f"{said}.*; export the model with the 2D points of its photos, or train"):
        if metric:
            make_metric_scale(colmap_scene, depths, Metric(0.01, None), "txt")
        else:
            make_depth_params(colmap_scene, depths, "txt")
    assert not (colmap_scene / "sparse" / "0" / "depth_params.json").exists()


def test_hold_out_takes_every_8th_and_extent_comes_from_training_views(colmap_scene):
    every, held = read(colmap_scene), read(colmap_scene, hold_out=True)
    names = [camera.image_name for camera in every.train_cameras]
    assert every.test_cameras == [] and len(names) == 17
    assert [camera.image_name for camera in held.test_cameras] == [names[0], names[8], names[16]]
    assert [c.image_name for c in held.train_cameras] == [n for i, n in enumerate(names) if i % 8]
    centers = np.array([-c.R @ c.T for c in held.train_cameras])
    assert held.extent == pytest.approx(1.1 * np.linalg.norm(centers - centers.mean(0), axis=1).max(), rel=1e-12)
    assert held.extent != every.extent


def test_extent_of_cameras_in_one_place(colmap_scene):
    info = read(colmap_scene)
    camera, points = info.train_cameras[0], info.point_cloud.points
    depths = (points @ camera.R + camera.T)[:, 2]
    assert scene_extent([camera], points) == pytest.approx(1.1 * np.median(depths[depths > 0]))
    assert scene_extent([camera] * 3, points) == scene_extent([camera], points)
    assert scene_extent([camera], points[:0]) == 1.0


def test_a_fresh_scene_writes_its_side_files_and_leaves_the_dataset_alone(colmap_scene, tmp_path):
    before = folder_state(colmap_scene)
    gaussians = FakeGaussians()
    scene = Scene(options_of(colmap_scene, tmp_path / "out", eval=True), gaussians)
    assert (len(scene.getTrainCameras()), len(scene.getTestCameras())) == (14, 3)
    for camera in scene.getTrainCameras():
        camera.target(torch.zeros(3))
        assert camera.images is scene.images
    assert scene.loaded_iter is None and scene.cameras_extent == gaussians.extent
    scene.save(7)
    assert folder_state(colmap_scene) == before
    written = sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert written == ["cameras.json", "input.ply", "point_cloud/iteration_7/point_cloud.ply"]

    info = read(colmap_scene, hold_out=True)
    entries = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert [entry["id"] for entry in entries] == list(range(17))
    assert [entry["img_name"] for entry in entries] == [c.image_name for c in info.test_cameras + info.train_cameras]

    cloud = read_point_cloud(tmp_path / "out" / "input.ply")
    np.testing.assert_array_equal(cloud.points, gaussians.pcd.points)
    np.testing.assert_array_equal(cloud.colors, gaussians.pcd.colors)


def test_order_of_views_and_numbers(colmap_scene, tmp_path):
    options = options_of(colmap_scene, tmp_path / "out")
    kept = Scene(options, FakeGaussians(), shuffle=False).getTrainCameras()
    assert [camera.uid for camera in kept] == list(range(17))
    assert [c.image_name for c in kept] == sorted([c.image_name for c in kept], key=os.fsencode)
    mixed, again = (Scene(options, FakeGaussians()).getTrainCameras() for _ in range(2))
    assert [c.uid for c in mixed] == [c.uid for c in again] != [c.uid for c in kept]
    assert {c.uid: c.image_name for c in mixed} == {c.uid: c.image_name for c in kept}


def test_a_given_cloud_is_used_and_copied_byte_for_byte(colmap_scene, tmp_path):
    ply = tmp_path / "mine.ply"
    ply.write_text(
        "ply\nformat ascii 1.0\ncomment kept\nelement vertex 2\nproperty double z\nproperty double y\n"
        "property double x\nproperty float red\nproperty float green\nproperty float blue\nend_header\n"
        "1 2 3 0.5 0 1\n4 5 6 1 1 0\n"
    )
    gaussians = FakeGaussians()
    Scene(options_of(colmap_scene, tmp_path / "out", init_pcd_path=str(ply)), gaussians)
    np.testing.assert_array_equal(gaussians.pcd.points, [[3, 2, 1], [6, 5, 4]])
    np.testing.assert_array_equal(gaussians.pcd.colors, np.float32([[0.5, 0, 1], [1, 1, 0]]))
    assert (tmp_path / "out" / "input.ply").read_bytes() == ply.read_bytes()


def test_the_datasets_own_ply_is_used_unless_it_is_older(colmap_scene, tmp_path, capsys):
    sparse = colmap_scene / "sparse" / "0"
    ply = sparse / "points3D.ply"
    write_point_cloud(ply, np.array([[1.0, 2.0, 3.0]]), np.array([[255, 0, 51]]))
    assert len(read(colmap_scene).point_cloud.points) == 1
    gaussians = FakeGaussians()
    Scene(options_of(colmap_scene, tmp_path / "out"), gaussians)
    assert (tmp_path / "out" / "input.ply").read_bytes() == ply.read_bytes()
    np.testing.assert_array_equal(gaussians.pcd.colors, np.float32([[1, 0, 0.2]]))

    age = (sparse / "points3D.bin").stat().st_mtime - 10
    os.utime(ply, (age, age))
    assert len(read(colmap_scene).point_cloud.points) == 300
    assert "points3D.ply is older than points3D.bin" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "what"), [("images.bin", "photo"), ("points3D.bin", "point")])
@pytest.mark.parametrize("bit", [33, 40, 63])
def test_a_count_beyond_the_file_is_refused(colmap_scene, name, what, bit):
    """The count of records and that of the first record's items are changed in turn."""
    path = colmap_scene / "sparse" / "0" / name
    whole = path.read_bytes()
    for place in (0, {"images.bin": whole.find(b"png\0") + 4, "points3D.bin": 8 + 43}[name]):
        number = int.from_bytes(whole[place : place + 8], "little") | 1 << bit
        path.write_bytes(whole[:place] + number.to_bytes(8, "little") + whole[place + 8 :])
        with pytest.raises(UserError, match=rf"{name} ends within {what} [0-9]+ of [0-9,]+, or is no such file"):
            read_model(path.parent)


@pytest.mark.parametrize(
    ("name", "views", "held", "points", "extent"),
    [("fox_tiny", 50, 7, 12475, 4.80), ("monstree_mixed", 23, 3, 9702, 7.33), ("bonsai_small", 73, 10, 11167, 5.13)],
)
def test_real_scenes(shared_dir, tmp_path, name, views, held, points, extent):
    folder = shared_dir / "scenes" / name
    scene = Scene(options_of(folder, tmp_path / "out", eval=True), FakeGaussians())
    assert (len(scene.getTrainCameras()), len(scene.getTestCameras())) == (views - held, held)
    assert len(scene.gaussians.pcd.points) == points
    assert scene.cameras_extent == pytest.approx(extent, abs=0.01)
    for camera in scene.getTestCameras():
        assert camera.target(torch.zeros(3)).shape == (3, camera.image_height, camera.image_width)


@pytest.mark.parametrize("name", ["input.ply", "cameras.json"])
def test_a_model_may_lie_in_its_dataset_but_overwrites_nothing(colmap_scene, tmp_path, name):
    shutil.copytree(colmap_scene, tmp_path / "other")
    before = folder_state(colmap_scene)
    for place in (".", ".", "output"):
        Scene(options_of(colmap_scene, colmap_scene / place), FakeGaussians())
        assert before.items() <= folder_state(colmap_scene).items() and (colmap_scene / place / name).exists()
    (tmp_path / "other" / name).write_text("theirs")
    before = folder_state(tmp_path / "other")
    with pytest.raises(UserError, match=f"would overwrite the scene's {name}; name another folder with -m"):
        Scene(options_of(tmp_path / "other", tmp_path / "other"), FakeGaussians())
    assert folder_state(tmp_path / "other") == before


@pytest.mark.parametrize(
    ("gpus", "taken", "not_taken"),
    [
        (0, ("cuda", "cpu"), ("toaster", "meta", "mps", "cuda:3")),
        (2, ("cuda", "cuda:1", "cpu"), ("meta", "xpu", "cuda:3")),
    ],
)
def test_image_device(gpus, taken, not_taken, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    computing = torch.device("cuda" if gpus else "cpu")
    for name in taken:
        assert image_device(name, computing, warn=True) == (torch.device(name) if gpus else computing)
    assert capsys.readouterr().err == ""
    for name in not_taken:
        assert image_device(name, computing, warn=True) == computing
        assert f"warning: --data_device {name} is n" in capsys.readouterr().err


def test_pycolmap_disturbs_neither_png_nor_sigterm(tmp_path):
    """Two zlibs must not clash, and glog alone would dump the stack, with the same status."""
    script = (
        "import os, signal, sys\n"
        "from scene.images.lens import import_pycolmap\n"
        "import_pycolmap()\n"
        "from PIL import Image\n"
        "Image.effect_noise((64, 64), 50).convert('RGB').save(sys.argv[1])\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "a.png")]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")
    assert Image.open(tmp_path / "a.png").size == (64, 64)


@pytest.mark.parametrize("square", [True, False])
def test_photos_of_another_aspect_than_a_camera_of_square_pixels(tmp_path, capsys, square):
    make_colmap_scene(tmp_path, params=(110.0, 110.0 if square else 140.0, 45.0, 34.5), views=4)
    for path in (tmp_path / "images").rglob("*.png"):
        Image.open(path).crop((0, 0, 64, 64)).save(path)
    read(tmp_path)
    said = capsys.readouterr().err
    assert "4 of 4 photos do not have the aspect ratio of their camera" in said
    assert ("its pixels are square (fx = fy), so the photos are rather padded or cropped" in said) == square


def test_a_render_uses_the_model_of_several_that_its_training_does(colmap_scene):
    """A model with broken points is none, though a render needs no points."""
    as_text(colmap_scene)
    sparse = colmap_scene / "sparse"
    shutil.copytree(sparse / "0", sparse / "1")
    with open(sparse / "0" / "points3D.txt", "a") as file:
        file.write("99 0 0 x 9 9 9 0.5\n")
    assert [find_model(colmap_scene, with_points)[0].name for with_points in (True, False)] == ["1", "1"]
