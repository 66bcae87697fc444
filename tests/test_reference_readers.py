"""Readers and records with the reference's names: both releases' forms, against our own readers and plain formulas."""

import argparse
import copy
import dataclasses
import json
import os
import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from synthetic import folder_state, make_colmap_scene

from scene import colmap_loader
from scene.dataset_readers import (
    BasicPointCloud,
    CameraInfo,
    SceneInfo,
    fetchPly,
    focal2fov,
    fov2focal,
    getNerfppNorm,
    read_scene,
    readCamerasFromTransforms,
    readColmapCameras,
    readColmapSceneInfo,
    readNerfstudioInfo,
    readNerfSyntheticInfo,
    scene_extent,
    sceneLoadTypeCallbacks,
    storePly,
)
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, DepthMap
from scene.readers.info import exposure_names, photo_size
from utils.camera_utils import loadCam
from utils.system_utils import UserError

FIELDS = (
    *("uid", "R", "T", "FovY", "FovX", "depth_params", "image_path", "image_name", "depth_path"),
    *("width", "height", "is_test"),
)


def _values(**changes) -> dict:
    """The reference's fields of a view, 160 x 120 pixels."""
    values = {
        **{"uid": 3, "R": np.eye(3), "T": np.array([1.0, 2.0, 3.0]), "FovY": 0.6, "FovX": 0.8, "depth_params": None},
        **{"image_path": "none/a.png", "image_name": "a.png", "depth_path": "", "width": 160, "height": 120},
        "is_test": True,
    }
    return {**values, **changes}


# Records


def test_a_view_made_of_the_references_fields():
    values = _values()
    info = CameraInfo(**values)
    assert info._fields == FIELDS == tuple(values) == tuple(info._asdict())
    assert CameraInfo(*values.values())._asdict() == info._asdict() == values
    assert (len(info), info[0], info[-1], info[9:11]) == (12, 3, True, (160, 120))
    uid, R, *_, is_test = info
    assert (uid, R, is_test) == (3, values["R"], True)
    assert (info.fx, info.fy) == (fov2focal(0.8, 160), fov2focal(0.6, 120))
    assert (info.cx, info.cy) == (80, 60)
    assert info.image is None and info.mask is None and info.depth is None and not info.ignore_alpha
    with pytest.raises(dataclasses.FrozenInstanceError):
        info.width = 5
    with pytest.raises(TypeError, match="needs width, and FovX or fx"):
        CameraInfo(3, np.eye(3), np.zeros(3), FovY=0.6, width=160, height=120)
    with pytest.raises(TypeError, match="needs height"):
        CameraInfo(3, np.eye(3), np.zeros(3), 0.6, 0.8, width=160)


class _Larger(CameraInfo):
    """A subclass as one of a named tuple is written, with fields by names that ours has, too."""

    def __new__(cls, *args, label="", mask=None, cx=None, **kwargs):
        info = super().__new__(cls, *args, **kwargs)
        info.label, info.mask, info.cx = label, mask, cx
        return info


def test_a_subclass_may_make_itself_as_one_of_a_named_tuple(tmp_path):
    Image.new("RGB", (160, 120), "teal").save(tmp_path / "a.png")
    mask, values = np.ones((120, 160)), _values(image_path=str(tmp_path / "a.png"), depth_path="")
    info = _Larger(**values, label="x", mask=mask, cx=np.float32(70))
    assert info._asdict() == values and (info.label, info.cx) == ("x", 70) and info.mask is mask
    for twin in (copy.copy(info), copy.deepcopy(info), pickle.loads(pickle.dumps(info))):
        assert type(twin) is _Larger and (twin.label, twin.fx, twin.uid) == ("x", info.fx, 3)
    info.group = 7
    with pytest.raises(AttributeError, match="make another one by _replace"):
        info.width = 5
    args = argparse.Namespace(resolution=2, data_device="cpu", train_test_exp=False)
    camera = loadCam(args, 0, info, 1.0)
    assert (camera.image_width, camera.cx) == (80, 35) and camera.counted_pixels is None


def test_a_view_made_of_2023s_fields():
    image = Image.new("RGB", (40, 30))
    values = _values()
    for name in ("depth_params", "depth_path", "is_test"):
        del values[name]
    info = CameraInfo(**values, image=image)
    assert info.image is image and photo_size(info) == (40, 30)
    assert (info.depth_params, info.depth_path, info.is_test) == (None, "", False)


def test_focal_lengths_of_a_reader_are_exact():
    info = CameraInfo(1, np.eye(3), np.zeros(3), fx=123.456, fy=78.9, cx=70.5, width=160, height=120)
    assert (info.fx, info.fy, info.cx, info.cy) == (123.456, 78.9, 70.5, 60)
    assert (info.FovX, info.FovY) == (focal2fov(123.456, 160), focal2fov(78.9, 120))
    again = dataclasses.replace(info, T=np.ones(3))
    assert (again.fx, again.FovX, again.cx) == (info.fx, info.FovX, info.cx)
    turned = CameraInfo(**_values(FovX=0.7654321))
    assert dataclasses.replace(turned, uid=9).FovX == 0.7654321


def test_replacing_a_field_keeps_what_belongs_together():
    info = CameraInfo(**_values(), cx=70.0, mask="mask", file_size=(320, 240))
    assert info._replace(FovX=0.5).fx == fov2focal(0.5, 160)
    assert info._replace(fx=100.0).FovX == focal2fov(100.0, 160)
    half = info._replace(width=80, height=60)
    assert (half.FovX, half.FovY) == (info.FovX, info.FovY)
    np.testing.assert_allclose((half.fx, half.fy, half.cx, half.cy), np.array([info.fx, info.fy, 70, 60]) / 2)
    assert (half.mask, half.file_size) == ("mask", (320, 240))
    other = info._replace(image_path="none/b.png", image_name="b.png")
    assert (other.image_path, other.image_name, other.cx) == ("none/b.png", "b.png", 70)
    assert photo_size(other) == (160, 120)  # of another photo, which is missing
    assert info.image_name == "a.png"
    with pytest.raises(TypeError, match="no_field"):
        info._replace(no_field=1)


def test_the_size_of_the_photo_is_read_when_it_is_asked_for(tmp_path):
    info = CameraInfo(**_values(image_path=str(tmp_path / "a.png")))
    assert photo_size(info) == (160, 120)
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png")
    for twin in (info, copy.deepcopy(info), pickle.loads(pickle.dumps(info))):
        assert photo_size(twin) == (64, 48) and twin.fx == info.fx


def test_a_scene_made_of_the_references_fields():
    cloud = BasicPointCloud(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 3)))
    views = [CameraInfo(**_values())]
    scene = SceneInfo(cloud, views, [], {"translate": np.zeros(3), "radius": np.float32(2.5)}, "a.ply")
    assert scene._fields == (
        *("point_cloud", "train_cameras", "test_cameras", "nerf_normalization", "ply_path", "is_nerf_synthetic"),
    )
    assert scene.extent == 2.5 and type(scene.extent) is float
    assert not scene.is_nerf_synthetic and not scene.offset.any()
    cloud_, train, *_ = scene
    assert cloud_ is cloud and train is views and len(scene) == 6
    changed = scene._replace(test_cameras=views, is_nerf_synthetic=True)
    assert changed.test_cameras is views and changed.is_nerf_synthetic and changed.point_cloud is cloud
    assert SceneInfo(*scene)._asdict() == scene._asdict()


def test_our_code_takes_records_of_the_references_fields():
    infos = [CameraInfo(**_values(T=np.array(T), image_name=f"{T[0]}.png")) for T in ([0.0, 0, 0], [2.0, 0, 0])]
    assert scene_extent(infos) == pytest.approx(1.1)
    assert exposure_names(infos) == ["0.0.png", "2.0.png"]
    plain = [SimpleNamespace(R=c.R, T=c.T, image_name=c.image_name) for c in infos]
    assert scene_extent(plain) == pytest.approx(1.1) and exposure_names(plain) == ["0.0.png", "2.0.png"]
    # Names clash only in the first two, and one of these has no path.
    plain += [SimpleNamespace(image_name="2.0.png", image_path="/s/test/2.0.png")]
    plain += [SimpleNamespace(image_name="c.png", image_path="/s/train/c.png")]
    assert exposure_names(plain) == ["0.0.png", "2.0.png", "test/2.0.png", "c.png"]


# Points and sizes


def test_plys_go_both_ways(tmp_path):
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(256, 3)), np.repeat(np.arange(256)[:, None], 3, axis=1)
    storePly(str(tmp_path / "a.ply"), xyz, rgb)
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    kinds = [(p.name, p.val_dtype) for p in vertices.properties]
    assert kinds == [(n, "f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [
        (n, "u1") for n in ("red", "green", "blue")
    ]
    cloud = fetchPly(str(tmp_path / "a.ply"))
    assert isinstance(cloud, BasicPointCloud) and cloud.points.dtype == np.float32
    np.testing.assert_array_equal(cloud.points, xyz.astype(np.float32))
    np.testing.assert_array_equal(cloud.colors, rgb / 255.0)
    assert not cloud.normals.any() and cloud.normals.shape == (256, 3)
    # Colours survive the truncation of the way back.
    storePly(tmp_path / "b.ply", cloud.points, cloud.colors * 255)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    storePly(tmp_path / "c.ply", xyz[:2], [[127.9, -3, 300]] * 2)
    np.testing.assert_array_equal(fetchPly(tmp_path / "c.ply").colors[0] * 255, [127, 0, 255])
    with pytest.raises(UserError, match="no point cloud"):
        fetchPly(tmp_path / "none.ply")


def test_the_norm_is_the_plain_rule():
    rng = np.random.default_rng(0)
    infos = [SimpleNamespace(R=np.linalg.qr(rng.normal(size=(3, 3)))[0], T=rng.normal(size=3)) for _ in range(9)]
    infos[4].T = infos[4].T + 900  # which stands apart
    centers = np.array([-info.R @ info.T for info in infos])
    norm = getNerfppNorm(infos)
    np.testing.assert_allclose(norm["translate"], -centers.mean(axis=0))
    assert norm["radius"] == pytest.approx(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    assert getNerfppNorm(infos[:1])["radius"] == 0
    skewed = SimpleNamespace(R=2 * infos[0].R, T=infos[0].T)  # of a scaled pose, which the matrix's inverse counts in
    np.testing.assert_allclose(getNerfppNorm([skewed])["translate"], infos[0].R @ infos[0].T / 2)
    assert scene_extent(infos) < norm["radius"] / 10


# COLMAP


def _same(view: CameraInfo, other: CameraInfo) -> None:
    np.testing.assert_allclose(view.R, other.R, atol=1e-14)
    np.testing.assert_array_equal(view.T, other.T)
    for name in ("uid", "FovX", "FovY", "fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(view, name) == getattr(other, name), name
    assert Path(view.image_path) == Path(other.image_path)


def test_a_colmap_scene_in_the_form_of_2024(colmap_scene, cache_folder):
    before = folder_state(colmap_scene)
    assert sceneLoadTypeCallbacks["Colmap"] is readColmapSceneInfo
    info = readColmapSceneInfo(str(colmap_scene), None, "", True, False)
    ours = read_scene(colmap_scene, "images", True)
    assert [c.image_name for c in info.train_cameras] == [c.image_name for c in ours.train_cameras]
    assert [c.image_name for c in info.test_cameras] == [c.image_name for c in ours.test_cameras]
    for view, other in zip(info.train_cameras + info.test_cameras, ours.train_cameras + ours.test_cameras, strict=True):
        _same(view, other)
        assert type(view.image_path) is str and os.path.isfile(view.image_path)
        assert view.is_test == other.is_test
        assert (view.depth_path, view.depth_params) == ("", None)
    assert [view.is_test for view in info.test_cameras] == [True] * 3 and not info.is_nerf_synthetic
    assert info.nerf_normalization["radius"] == pytest.approx(ours.extent)
    np.testing.assert_allclose(info.nerf_normalization["translate"], getNerfppNorm(info.train_cameras)["translate"])
    np.testing.assert_array_equal(info.point_cloud.points, ours.point_cloud.points)
    np.testing.assert_array_equal(info.point_cloud.colors.astype(np.float32), ours.point_cloud.colors)
    assert type(info.ply_path) is str and Path(info.ply_path).is_relative_to(cache_folder)
    np.testing.assert_array_equal(fetchPly(info.ply_path).points, info.point_cloud.points)
    assert folder_state(colmap_scene) == before
    assert readColmapSceneInfo(colmap_scene, "images", "", False, False).ply_path == info.ply_path


def test_the_hold_of_a_colmap_scene(colmap_scene):
    names = [c.image_name for c in readColmapSceneInfo(colmap_scene, "images", "", False, False).train_cameras]
    assert len(names) == 17 and names == sorted(names)
    info = readColmapSceneInfo(
        path=colmap_scene, images="images", depths="", eval=True, train_test_exp=False, llffhold=5
    )
    assert [c.image_name for c in info.test_cameras] == names[::5]
    info = readColmapSceneInfo(colmap_scene, "images", "", True, True)
    assert [c.image_name for c in info.train_cameras] == names
    assert [c.image_name for c in info.train_cameras if c.is_test] == names[::8]
    with pytest.raises(UserError, match="test.txt"):
        readColmapSceneInfo(colmap_scene, "images", "", True, False, 0)
    (colmap_scene / "sparse" / "0" / "test.txt").write_text(f"{names[2]}\n{names[11]}\nother.png\n")
    info = readColmapSceneInfo(colmap_scene, "images", "", True, False, 0)
    assert [c.image_name for c in info.test_cameras] == [names[2], names[11]] and len(info.train_cameras) == 15
    with pytest.raises(UserError, match="all 17 photos"):
        readColmapSceneInfo(colmap_scene, "images", "", True, False, 1)


def test_a_colmap_scene_in_the_form_of_2023(colmap_scene):
    stems = sorted(path.stem for path in (colmap_scene / "images").rglob("*.png"))
    for info in (
        readColmapSceneInfo(colmap_scene, "images", True),
        readColmapSceneInfo(colmap_scene, None, True, 8),
        readColmapSceneInfo(colmap_scene, "images", eval=True, llffhold=8),
    ):
        assert [c.image_name for c in info.test_cameras] == stems[::8]
        assert [c.image_name for c in info.train_cameras] == [stem for i, stem in enumerate(stems) if i % 8]
    assert [c.image_name for c in readColmapSceneInfo(colmap_scene, "images", True, 4).test_cameras] == stems[::4]
    assert len(readColmapSceneInfo(colmap_scene, "images", False).train_cameras) == 17


def _write_depths(scene: Path, names: list[str], skipped: str, unreliable: str) -> dict[str, dict[str, float]]:
    params = {
        Path(name).with_suffix("").as_posix(): {"scale": 2.0, "offset": 0.25} for name in names if name != skipped
    }
    params[Path(unreliable).with_suffix("").as_posix()]["scale"] = 99.0
    (scene / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))
    for name in names:
        path = (scene / "depths" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((6, 8), 30000, np.uint16)).save(path)
    return {name: {**entry, "med_scale": 2.0} for name, entry in params.items()}


def test_depth_maps_of_a_colmap_scene(colmap_scene):
    names = [c.image_name for c in readColmapSceneInfo(colmap_scene, "images", "", False, False).train_cameras]
    params = _write_depths(colmap_scene, names, skipped=names[1], unreliable=names[2])
    views = readColmapSceneInfo(str(colmap_scene), "images", "depths", True, False).train_cameras
    for view in views:
        name = view.image_name.removesuffix(".png")
        path = colmap_scene / "depths" / f"{name}.png"
        found = path, params.get(name), DepthMap(path, COLMAP_UNIT, 2.0, 0.25)
        wanted = (Path(""), None, None) if view.image_name in names[1:3] else found
        assert (Path(view.depth_path), view.depth_params, view.depth) == wanted
    both = readColmapSceneInfo(str(colmap_scene), "images", "depths", True, True).train_cameras
    assert len(both) == 17 and sum(view.depth is not None for view in both) == 15
    (colmap_scene / "sparse" / "0" / "depth_params.json").unlink()
    with pytest.raises(UserError, match="depth_params.json"):
        readColmapSceneInfo(str(colmap_scene), "images", "depths", True, False)

    images, cameras = _model(colmap_scene)
    folders = str(colmap_scene / "images"), str(colmap_scene / "depths")
    views = readColmapCameras(images, cameras, params, *folders, [names[0]])
    views = {view.image_name: view for view in views}
    assert (views[names[1]].depth_path, views[names[1]].depth_params, views[names[1]].depth) == ("", None, None)
    assert views[names[2]].depth_params["scale"] == 99 and views[names[2]].depth is None
    for name in [names[0], *names[2:]]:
        assert views[name].depth_path == os.path.join(folders[1], name.removesuffix(".png") + ".png")
    assert [name for name, view in views.items() if view.is_test] == [names[0]]
    assert views[names[3]].depth == DepthMap(Path(views[names[3]].depth_path), COLMAP_UNIT, 2.0, 0.25)


def _model(scene: Path) -> tuple[dict, dict]:
    folder = scene / "sparse" / "0"
    return (
        colmap_loader.read_extrinsics_binary(folder / "images.bin"),
        colmap_loader.read_intrinsics_binary(folder / "cameras.bin"),
    )


def test_views_of_single_files(colmap_scene):
    images, cameras = _model(colmap_scene)
    ours = {view.image_name: view for view in read_scene(colmap_scene, "images", False).train_cameras}
    views = readColmapCameras(images, cameras, None, str(colmap_scene / "images"), "", [])
    assert [view.image_name for view in views] == [image.name for image in images.values()]
    for view in views:
        _same(view, ours[view.image_name])
        assert (view.depth_params, view.depth_path, view.is_test) == (None, "", False)
    old = readColmapCameras(images, cameras, str(colmap_scene / "images"))
    assert [view.image_name for view in old] == [Path(view.image_path).stem for view in views]
    by_name = readColmapCameras(cam_extrinsics=images, cam_intrinsics=cameras, images_folder=colmap_scene / "nowhere")
    assert [photo_size(view) for view in by_name] == [(96, 64)] * 17  # poses do not need the photos


def test_views_of_a_lens_that_distorts_are_undistorted(tmp_path, cache_folder):
    make_colmap_scene(tmp_path, model="OPENCV", params=(110, 110, 45, 34.5, 0.1, 0.02, 0.001, 0.0), views=3)
    views = readColmapCameras(*_model(tmp_path), None, str(tmp_path / "images"), "", [])
    ours = {view.image_name: view for view in read_scene(tmp_path, "images", False).train_cameras}
    for view in views:
        _same(view, ours[view.image_name])
        assert Path(view.image_path).is_relative_to(cache_folder)


# Blender and nerfstudio


def test_a_blender_scene_in_both_forms(blender_scene, cache_folder):
    before = folder_state(blender_scene)
    assert sceneLoadTypeCallbacks["Blender"] is readNerfSyntheticInfo
    info = readNerfSyntheticInfo(str(blender_scene), True, "", True)
    ours = read_scene(blender_scene, "", True)
    for view, other in zip(info.train_cameras + info.test_cameras, ours.train_cameras + ours.test_cameras, strict=True):
        _same(view, other)
        assert (view.image_name, view.is_test) == (other.image_name, other.is_test)
    assert [view.is_test for view in info.test_cameras] == [True, True]
    assert info.is_nerf_synthetic and ours.is_nerf_synthetic
    assert len(info.point_cloud.points) == 100_000 and np.abs(info.point_cloud.points).max() <= 1.3
    np.testing.assert_array_equal(info.point_cloud.colors, 127 / 255)
    assert Path(info.ply_path).is_relative_to(cache_folder)
    joined = readNerfSyntheticInfo(blender_scene, False, "", False)
    assert [view.is_test for view in joined.train_cameras] == [False] * 4 + [True] * 2 and not joined.test_cameras
    old = readNerfSyntheticInfo(str(blender_scene), True, True, ".png")
    assert (len(old.train_cameras), len(old.test_cameras)) == (4, 2)
    assert len(readNerfSyntheticInfo(blender_scene, white_background=True, eval=False).train_cameras) == 6
    assert folder_state(blender_scene) == before


def test_one_camera_file_in_both_forms(blender_scene):
    views = readCamerasFromTransforms(str(blender_scene), "transforms_test.json", "", False, True)
    assert [(view.image_name, view.is_test, view.uid) for view in views] == [("r_0", True, 0), ("r_1", True, 1)]
    old = readCamerasFromTransforms(str(blender_scene), "transforms_test.json", True, ".png")
    assert [(view.image_name, view.is_test) for view in old] == [("r_0", False), ("r_1", False)]
    for path in (blender_scene / "test").glob("*.png"):
        Image.open(path).convert("RGB").save(path.with_suffix(".jpg"))
    for views in (
        readCamerasFromTransforms(blender_scene, "transforms_test.json", "", False, True, ".jpg"),
        readCamerasFromTransforms(blender_scene, "transforms_test.json", False, ".jpg"),
    ):
        assert [Path(view.image_path).name for view in views] == ["r_0.jpg", "r_1.jpg"]
    deep = readCamerasFromTransforms(blender_scene, "transforms_test.json", "/depths", False, True)
    assert [view.depth_path for view in deep] == ["/depths/r_0.png", "/depths/r_1.png"]
    assert deep[0].depth == DepthMap(Path("/depths/r_0.png"), BLENDER_UNIT) and deep[0].depth_params is None
    with pytest.raises(UserError, match="transforms_other.json"):
        readCamerasFromTransforms(blender_scene, "transforms_other.json", "", False, False)


def test_depth_maps_of_a_blender_scene(blender_scene):
    for path in (blender_scene / "train").glob("*.png"):
        (blender_scene / "depths").mkdir(exist_ok=True)
        Image.fromarray(np.full((6, 8), 700, np.uint16)).save(blender_scene / "depths" / path.name)
    info = readNerfSyntheticInfo(str(blender_scene), False, "depths", True)
    for view in info.train_cameras:
        path = blender_scene / "depths" / f"{view.image_name}.png"
        assert Path(view.depth_path) == path and view.depth == DepthMap(path, BLENDER_UNIT)
        assert view.depth_params is None


def test_a_nerfstudio_scene_like_a_blender_scene(blender_scene, tmp_path):
    content = json.loads((blender_scene / "transforms_train.json").read_text())
    content["ply_file_path"] = "points.ply"
    storePly(blender_scene / "points.ply", np.eye(3), np.zeros((3, 3)))
    (blender_scene / "transforms.json").write_text(json.dumps(content))
    for name in ("train", "test"):
        (blender_scene / f"transforms_{name}.json").unlink()
    info = readNerfstudioInfo(str(blender_scene), False, "", True)
    assert (len(info.train_cameras), len(info.test_cameras), info.is_nerf_synthetic) == (3, 1, False)
    assert info.ply_path == str(blender_scene / "points.ply") and type(info.train_cameras[0].image_path) is str
