"""COLMAP folders from end to end: from files to views, cloud, extent and side files; messages for faulty folders."""

import argparse
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
from synthetic import CENTER, FOCAL, FakeGaussians, folder_state, make_colmap_scene

from arguments import ModelParams
from scene import Scene
from scene.dataset_readers import read_scene, scene_extent
from scene.images.store import picture_device
from scene.readers import colmap_model
from scene.readers.point_cloud import read_point_cloud, write_point_cloud
from utils.system_utils import UserError


def _options(scene: Path, out: Path, **changes) -> argparse.Namespace:
    given = argparse.Namespace(source_path=str(scene), model_path=str(out), **changes)
    return ModelParams(argparse.ArgumentParser()).extract(given)


def _read(scene: Path, hold_out: bool = False, init_pcd_path: str = "", **options):
    return read_scene(scene, "images", hold_out, init_pcd_path, **options)


def _as_text(scene: Path) -> pycolmap.Reconstruction:
    sparse = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(sparse))
    for path in sparse.iterdir():
        path.unlink()
    reconstruction.write_text(str(sparse))
    return reconstruction


def _assert_same(a, b) -> None:
    assert len(a.train_cameras) == len(b.train_cameras) > 0
    for one, other in zip(a.train_cameras, b.train_cameras, strict=True):
        assert (one.image_name, one.uid, one.width, one.height) == (
            other.image_name,
            other.uid,
            other.width,
            other.height,
        )
        assert (one.fx, one.fy, one.cx, one.cy) == (other.fx, other.fy, other.cx, other.cy)
        np.testing.assert_array_equal(one.R, other.R)
        np.testing.assert_array_equal(one.T, other.T)
    np.testing.assert_array_equal(a.point_cloud.points, b.point_cloud.points)
    np.testing.assert_array_equal(a.point_cloud.colors, b.point_cloud.colors)


def test_values_are_the_models(colmap_scene):
    reconstruction = pycolmap.Reconstruction(str(colmap_scene / "sparse" / "0"))
    info = _read(colmap_scene)
    names = [camera.image_name for camera in info.train_cameras]
    assert names == sorted((image.name for image in reconstruction.images.values()), key=os.fsencode)
    assert names[0].startswith("Right/V") and names[-1].startswith("left/v")
    for camera in info.train_cameras:
        image = reconstruction.find_image_with_name(camera.image_name)
        pose = image.cam_from_world().matrix()
        np.testing.assert_array_equal(camera.R.T, pose[:, :3])
        np.testing.assert_array_equal(camera.T, pose[:, 3])
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FOCAL, FOCAL, *CENTER)
        assert camera.image_path == colmap_scene / "images" / camera.image_name
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    cloud = info.point_cloud
    assert cloud.points.dtype == cloud.colors.dtype == np.float32
    np.testing.assert_array_equal(cloud.points, np.float32([point.xyz for point in points]))
    np.testing.assert_array_equal(cloud.colors, np.float32([point.color for point in points]) / 255)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_text_equals_binary(tmp_path, model):
    params = (FOCAL, *CENTER) if model == "SIMPLE_PINHOLE" else (FOCAL, FOCAL, *CENTER)
    make_colmap_scene(tmp_path, model=model, params=params, views=5)
    binary = _read(tmp_path)
    _as_text(tmp_path)
    _assert_same(_read(tmp_path), binary)


def test_the_three_classic_files_and_sparse_itself_suffice(colmap_scene):
    whole = _read(colmap_scene)
    sparse = colmap_scene / "sparse"
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        shutil.move(sparse / "0" / name, sparse / name)
    shutil.rmtree(sparse / "0")
    _assert_same(_read(colmap_scene), whole)


def test_empty_second_lines_in_text(colmap_scene):
    whole = _read(colmap_scene)
    _as_text(colmap_scene)
    sparse = colmap_scene / "sparse" / "0"
    lines = [line for line in (sparse / "images.txt").read_text().splitlines() if not line.startswith("#")]
    lines[1::2] = [""] * len(lines[1::2])
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "points3D.txt").write_text("")
    info = _read(colmap_scene, want_cloud=False)
    assert [c.image_name for c in info.train_cameras] == [c.image_name for c in whole.train_cameras]
    with pytest.raises(UserError, match="has no points; start from random points with --init_type random"):
        _read(colmap_scene)


def test_broken_binary_falls_back_to_text(colmap_scene):
    whole = _read(colmap_scene)
    sparse = colmap_scene / "sparse" / "0"
    pycolmap.Reconstruction(str(sparse)).write_text(str(sparse))
    (sparse / "cameras.bin").write_bytes((sparse / "cameras.bin").read_bytes()[:-5])
    _assert_same(_read(colmap_scene), whole)


def test_hold_out_takes_every_8th_and_extent_comes_from_training_views(colmap_scene):
    every, held = _read(colmap_scene), _read(colmap_scene, hold_out=True)
    names = [camera.image_name for camera in every.train_cameras]
    assert every.test_cameras == [] and len(names) == 17
    assert [camera.image_name for camera in held.test_cameras] == [names[0], names[8], names[16]]
    assert [c.image_name for c in held.train_cameras] == [n for i, n in enumerate(names) if i % 8]
    centers = np.array([-c.R @ c.T for c in held.train_cameras])
    assert held.extent == pytest.approx(1.1 * np.linalg.norm(centers - centers.mean(0), axis=1).max(), rel=1e-12)
    assert held.extent != every.extent


def test_extent_of_cameras_in_one_place(colmap_scene):
    info = _read(colmap_scene)
    camera, points = info.train_cameras[0], info.point_cloud.points
    depths = (points @ camera.R + camera.T)[:, 2]
    assert scene_extent([camera], points) == pytest.approx(1.1 * np.median(depths[depths > 0]))
    assert scene_extent([camera] * 3, points) == scene_extent([camera], points)
    assert scene_extent([camera], points[:0]) == 1.0


def test_a_fresh_scene_writes_its_side_files_and_leaves_the_dataset_alone(colmap_scene, tmp_path):
    before = folder_state(colmap_scene)
    gaussians = FakeGaussians()
    scene = Scene(_options(colmap_scene, tmp_path / "out", eval=True), gaussians)
    assert (len(scene.getTrainCameras()), len(scene.getTestCameras())) == (14, 3)
    for camera in scene.getTrainCameras():
        camera.target(torch.zeros(3))
    assert scene.loaded_iter is None and scene.cameras_extent == gaussians.extent
    scene.save(7)
    assert folder_state(colmap_scene) == before
    written = sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert written == ["cameras.json", "input.ply", "point_cloud/iteration_7/point_cloud.ply"]

    info = _read(colmap_scene, hold_out=True)
    entries = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert [entry["id"] for entry in entries] == list(range(17))
    assert [entry["img_name"] for entry in entries] == [c.image_name for c in info.test_cameras + info.train_cameras]
    assert list(entries[0]) == ["id", "img_name", "width", "height", "position", "rotation", "fy", "fx"]

    cloud = read_point_cloud(tmp_path / "out" / "input.ply")
    np.testing.assert_array_equal(cloud.points, gaussians.pcd.points)
    np.testing.assert_array_equal(cloud.colors, gaussians.pcd.colors)
    header = (tmp_path / "out" / "input.ply").read_bytes().split(b"end_header")[0].decode()
    assert [line.split()[1:] for line in header.splitlines() if line.startswith("property")] == [
        *[["float", name] for name in ("x", "y", "z", "nx", "ny", "nz")],
        *[["uchar", name] for name in ("red", "green", "blue")],
    ]


def test_order_of_views_and_numbers(colmap_scene, tmp_path):
    options = _options(colmap_scene, tmp_path / "out")
    kept = Scene(options, FakeGaussians(), shuffle=False).getTrainCameras()
    assert [camera.uid for camera in kept] == list(range(17))
    assert [c.image_name for c in kept] == sorted([c.image_name for c in kept], key=os.fsencode)
    mixed, again = (Scene(options, FakeGaussians()).getTrainCameras() for _ in range(2))
    assert [c.uid for c in mixed] == [c.uid for c in again] != [c.uid for c in kept]
    assert {c.uid: c.image_name for c in mixed} == {c.uid: c.image_name for c in kept}


def test_resolution_scales_and_the_size_option(colmap_scene, tmp_path):
    scene = Scene(
        _options(colmap_scene, tmp_path / "out", resolution=48), FakeGaussians(), resolution_scales=[1.0, 2.0]
    )
    for scale, size in ((1.0, (48, 32)), (2.0, (24, 16))):
        camera = scene.getTrainCameras(scale)[0]
        assert (camera.image_width, camera.image_height) == size
        assert camera.target(torch.zeros(3)).shape == (3, size[1], size[0])


def test_loading_a_saved_iteration(colmap_scene, tmp_path):
    options = _options(colmap_scene, tmp_path / "out")
    with pytest.raises(UserError, match="no saved iteration"):
        Scene(options, FakeGaussians(), load_iteration=-1)
    fresh = Scene(options, FakeGaussians())
    fresh.save(7)
    fresh.save(30)
    before = folder_state(tmp_path / "out")
    for asked, loaded in ((-1, 30), (7, 7)):
        gaussians = FakeGaussians()
        scene = Scene(options, gaussians, load_iteration=asked)
        assert scene.loaded_iter == loaded
        assert gaussians.loaded == str(tmp_path / "out" / "point_cloud" / f"iteration_{loaded}" / "point_cloud.ply")
    for missing in (0, 8):
        with pytest.raises(UserError, match=rf"iteration {missing} was never saved .*give one of 7, 30"):
            Scene(options, FakeGaussians(), load_iteration=missing)
    assert folder_state(tmp_path / "out") == before


def test_a_given_cloud_is_used_and_copied_byte_for_byte(colmap_scene, tmp_path):
    ply = tmp_path / "mine.ply"
    ply.write_text(
        "ply\nformat ascii 1.0\ncomment kept\nelement vertex 2\nproperty double z\nproperty double y\n"
        "property double x\nproperty float red\nproperty float green\nproperty float blue\nend_header\n"
        "1 2 3 0.5 0 1\n4 5 6 1 1 0\n"
    )
    gaussians = FakeGaussians()
    Scene(_options(colmap_scene, tmp_path / "out", init_pcd_path=str(ply)), gaussians)
    np.testing.assert_array_equal(gaussians.pcd.points, [[3, 2, 1], [6, 5, 4]])
    np.testing.assert_array_equal(gaussians.pcd.colors, np.float32([[0.5, 0, 1], [1, 1, 0]]))
    assert (tmp_path / "out" / "input.ply").read_bytes() == ply.read_bytes()


def test_the_datasets_own_ply_is_used_unless_it_is_older(colmap_scene, tmp_path, capsys):
    sparse = colmap_scene / "sparse" / "0"
    ply = sparse / "points3D.ply"
    write_point_cloud(ply, np.array([[1.0, 2.0, 3.0]]), np.array([[255, 0, 51]]))
    assert len(_read(colmap_scene).point_cloud.points) == 1
    gaussians = FakeGaussians()
    Scene(_options(colmap_scene, tmp_path / "out"), gaussians)
    assert (tmp_path / "out" / "input.ply").read_bytes() == ply.read_bytes()
    np.testing.assert_array_equal(gaussians.pcd.colors, np.float32([[1, 0, 0.2]]))

    age = (sparse / "points3D.bin").stat().st_mtime - 10
    os.utime(ply, (age, age))
    assert len(_read(colmap_scene).point_cloud.points) == 300
    assert "points3D.ply is older than points3D.bin" in capsys.readouterr().err


def test_another_aspect_ratio_is_reported(colmap_scene, capsys):
    picture = next((colmap_scene / "images" / "left").iterdir())
    Image.new("RGB", (96, 66)).save(picture)
    _read(colmap_scene)
    said = capsys.readouterr().err
    assert said.startswith("1 of 17 photos") and f"left/{picture.name} (96 x 66, camera 96 x 64)" in said


def test_bounded_store(colmap_scene, tmp_path):
    scene = Scene(_options(colmap_scene, tmp_path / "out", images_to_load=2), FakeGaussians())
    cameras = scene.getTrainCameras()
    first = [camera.target(torch.zeros(3)) for camera in cameras]
    assert len(cameras[0]._images) == 2
    assert all(
        torch.equal(camera.target(torch.zeros(3)), target) for camera, target in zip(cameras, first, strict=True)
    )


def test_picture_device(capsys):
    cpu = torch.device("cpu")
    assert picture_device("cuda", cpu) == picture_device("cpu", cpu) == cpu
    assert capsys.readouterr().err == ""
    for name in ("toaster", "meta", "mps", "cuda:3"):
        assert picture_device(name, cpu) == cpu
        assert f"warning: --data_device {name} is n" in capsys.readouterr().err


def test_picture_device_beside_a_gpu(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    gpu = torch.device("cuda")
    for name in ("cuda", "cuda:1", "cpu"):
        assert picture_device(name, gpu) == torch.device(name)
    assert capsys.readouterr().err == ""
    for name in ("meta", "mps", "xpu", "cuda:3"):
        assert picture_device(name, gpu) == gpu
        assert f"warning: --data_device {name} is n" in capsys.readouterr().err


# In a process that imports our module first: two zlibs must not clash.
def test_png_can_be_written_after_pycolmap_was_imported(tmp_path):
    script = (
        "import sys\n"
        "from scene.images.pycolmap_import import import_pycolmap\n"
        "import_pycolmap()\n"
        "from PIL import Image\n"
        "Image.effect_noise((64, 64), 50).convert('RGB').save(sys.argv[1])\n"
    )
    root = Path(__file__).resolve().parents[1]
    picture = tmp_path / "a.png"
    done = subprocess.run([sys.executable, "-c", script, str(picture)], cwd=root, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert Image.open(picture).size == (64, 64)


def _no_sparse(scene):
    shutil.rmtree(scene / "sparse")


def _empty_sparse(scene):
    for path in (scene / "sparse" / "0").glob("[ip]*"):
        path.unlink()


def _cut(name: str):
    def change(scene):
        path = scene / "sparse" / "0" / name
        path.write_bytes(path.read_bytes()[:-5])

    return change


def _missing_pictures(scene):
    for path in sorted((scene / "images" / "Right").iterdir())[:7]:
        path.unlink()


def _cut_picture(scene):
    path = scene / "images" / "left" / "v02.png"
    path.write_bytes(path.read_bytes()[:-40])


def _camera_model(scene):
    sparse = scene / "sparse" / "0"
    text = _as_text(scene) and (sparse / "cameras.txt").read_text()
    (sparse / "cameras.txt").write_text(text.replace("PINHOLE 96 64 110 110 45 34.5", "EQUIRECTANGULAR 96 64 96 64"))


def _no_views(scene):
    sparse = scene / "sparse" / "0"
    for path in sparse.iterdir():
        path.unlink()
    pycolmap.Reconstruction().write_binary(str(sparse))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_no_sparse, r"is not a scene: looked for the folder sparse .* transforms_train.json .*found images; "),
        (_empty_sparse, r"no COLMAP model in .*looked for cameras, images and points3D.*found sparse/0, .*cameras.bin"),
        (_cut("cameras.bin"), r"cameras.bin ends within camera 1 of 1, or is no such file; copy the file again"),
        (_cut("images.bin"), r"images.bin ends within photo 17 of 17"),
        (_cut("points3D.bin"), r"points3D.bin ends within point 300 of 300"),
        (_missing_pictures, r"7 of 17 photos that .* lists are missing: .*Right/V03.png, .* and 2 more; .*-i"),
        (_cut_picture, r"cannot read .*left/v02.png"),
        (_camera_model, r"photo Right/V03.png has the camera model EQUIRECTANGULAR, a panorama .*; cut it"),
        (_no_views, r"has no registered photo"),
    ],
)
def test_bad_scenes_get_one_sentence_and_no_output(colmap_scene, tmp_path, change, said):
    change(colmap_scene)
    with pytest.raises(UserError, match=said) as error:
        Scene(_options(colmap_scene, tmp_path / "out"), FakeGaussians())
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


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
            colmap_model.read_model(path.parent)


def test_a_points_file_cut_anywhere_is_refused(colmap_scene):
    path = colmap_scene / "sparse" / "0" / "points3D.bin"
    whole = path.read_bytes()
    for length in (1, 7, 8, 9, 50, 51, 53, 58, 59, 60, 1000, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError, match="points3D.bin ends within point [0-9]+ of "):
            colmap_model.read_model(path.parent)


def test_a_file_that_nobody_may_read_and_a_point_that_is_missing(colmap_scene, monkeypatch):
    sparse = colmap_scene / "sparse" / "0"
    (sparse / "points3D.bin").write_bytes(bytes(8))
    with pytest.raises(UserError, match=r"in .*images.bin sees a point that is not in points3D.bin; copy all three"):
        colmap_model.read_sightings(sparse, "bin")

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(UserError, match=r"cannot read .*cameras.bin \(Permission denied\); fix its permissions"):
        colmap_model.read_model(sparse)


@pytest.mark.parametrize(
    "params",
    [
        *((FOCAL, FOCAL, 45.0, 1e300), (FOCAL, FOCAL, -1e300, 34.5), (FOCAL, FOCAL, 1e39, 34.5)),
        *((FOCAL, FOCAL, 1e20, 34.5), (1e300, FOCAL, 45.0, 34.5), (1e-300, FOCAL, 45.0, 34.5)),
        (FOCAL, 5e-324, 45.0, 34.5),
    ],
)
@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_an_absurd_camera_is_refused(colmap_scene, model, params):
    sparse = colmap_scene / "sparse" / "0"
    _as_text(colmap_scene)
    more = " 0.1 0 0 0" if model == "OPENCV" else ""
    line = f"1 {model} 96 64 {' '.join(map(repr, params))}{more}\n"
    (sparse / "cameras.txt").write_text(line)
    with pytest.raises(UserError, match="camera of Right/V03.png has no usable size or focal length, or a principal"):
        _read(colmap_scene)


def test_cameras_for_parts_of_a_large_photo_and_for_a_telescope_are_taken(colmap_scene):
    _as_text(colmap_scene)
    (colmap_scene / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 96 64 500000 500000 -900 34.5\n")
    assert len(_read(colmap_scene).train_cameras) == 17


@pytest.mark.parametrize(
    ("translation", "said"),
    [("1e30 0 0", "more than 1e[+]12 from the origin"), ("0 1e300 0", "more than 1e[+]12 from the origin")],
)
def test_an_absurd_pose_is_refused(colmap_scene, translation, said):
    _as_text(colmap_scene)
    path = colmap_scene / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    words = lines[4].split()
    words[5:8] = translation.split()
    path.write_text("\n".join([*lines[:4], " ".join(words), *lines[5:]]) + "\n")
    with pytest.raises(UserError, match=said):
        _read(colmap_scene)


def test_no_such_folder(tmp_path):
    with pytest.raises(UserError, match="no scene folder .*nowhere"):
        Scene(_options(tmp_path / "nowhere", tmp_path / "out"), FakeGaussians())
    with pytest.raises(UserError, match="no scene folder given; name it with -s"):
        Scene(_options("", tmp_path / "out"), FakeGaussians())


def test_hold_out_needs_a_second_picture(tmp_path):
    make_colmap_scene(tmp_path, views=1)
    with pytest.raises(UserError, match="too few photos for --eval"):
        _read(tmp_path, hold_out=True)
    assert _read(tmp_path).extent > 0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no point cloud"),
        (b"not a ply", "not a readable PLY"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
            "has no z, red",
        ),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n", "has no x, y, z, red, green, blue"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
            b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 1 1 1\n0 nan 0 1 1 1\n",
            r"1 of 2 points .* are not finite \(first: number 1\)",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"property float red\nproperty float green\nproperty float blue\nend_header\n0 0 0 255 0 128\n",
            "neither integers nor between 0 and 1",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar float x\nproperty float y\n"
            b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
            b"2 1 1 0 0 1 1 1\n",
            "lists instead of numbers",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
            b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\nshort",
            "not a readable PLY",
        ),
    ],
)
def test_bad_clouds(colmap_scene, tmp_path, content, said):
    path = tmp_path / "cloud.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=said):
        _read(colmap_scene, init_pcd_path=str(path))


@pytest.mark.parametrize(
    ("name", "views", "held", "points", "extent"),
    [("fox_tiny", 50, 7, 12475, 4.80), ("monstree_mixed", 23, 3, 9702, 7.33), ("bonsai_small", 73, 10, 11167, 5.13)],
)
def test_real_scenes(shared_dir, tmp_path, name, views, held, points, extent):
    folder = shared_dir / "scenes" / name
    scene = Scene(_options(folder, tmp_path / "out", eval=True), FakeGaussians())
    assert (len(scene.getTrainCameras()), len(scene.getTestCameras())) == (views - held, held)
    assert len(scene.gaussians.pcd.points) == points
    assert scene.cameras_extent == pytest.approx(extent, abs=0.01)
    for camera in scene.getTestCameras():
        assert camera.target(torch.zeros(3)).shape == (3, camera.image_height, camera.image_width)


@pytest.mark.parametrize("place", [".", "out", "images/deep/out", "../colmap_scene/out"])
def test_nothing_is_written_into_the_dataset(colmap_scene, place):
    before = folder_state(colmap_scene)
    with pytest.raises(UserError, match="lies in the scene folder .*; name another folder with -m"):
        Scene(_options(colmap_scene, colmap_scene / place), FakeGaussians())
    assert folder_state(colmap_scene) == before
    Scene(_options(colmap_scene, colmap_scene.parent / "colmap_scene_out"), FakeGaussians())


def test_a_model_kept_in_the_dataset_can_be_used_without_the_cloud(colmap_scene):
    ply = colmap_scene / "out" / "point_cloud" / "iteration_7" / "point_cloud.ply"
    FakeGaussians().save_ply(str(ply))
    (colmap_scene / "sparse" / "0" / "points3D.ply").write_text("no PLY")
    options = _options(colmap_scene, colmap_scene / "out", init_pcd_path="absent.ply")
    scene = Scene(options, FakeGaussians(), load_iteration=-1)
    assert scene.gaussians.loaded == str(ply)
    assert scene.cameras_extent == pytest.approx(scene_extent(_read_cameras(colmap_scene)))


def _read_cameras(scene: Path):
    return _read(scene, want_cloud=False).train_cameras


def test_poses_that_are_not_finite_are_named(colmap_scene, monkeypatch):
    model = colmap_model.read_model(colmap_scene / "sparse" / "0")
    for part in ("rotation", "translation"):
        views = list(model.views)
        views[3] = views[3]._replace(**{part: np.full_like(getattr(views[3], part), np.nan)})
        monkeypatch.setattr(colmap_model, "read_model", lambda _, views=views: model._replace(views=views))
        with pytest.raises(UserError, match=f"pose of {views[3].name} is not finite"):
            _read(colmap_scene)


def test_sigterm_stays_quiet_after_pycolmap_was_imported():
    script = (
        "import os, signal\nfrom scene.images.pycolmap_import import import_pycolmap\n"
        "import_pycolmap()\nos.kill(os.getpid(), signal.SIGTERM)\n"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, check=False)
    # With pycolmap's import alone, glog would dump the stack, with the same status.
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")
