"""Readers and records with the reference's names: both releases' forms, against our own readers and plain formulas."""

import dataclasses
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from synthetic import folder_state

from scene import colmap_loader
from scene import dataset_readers as readers
from scene.readers.depth_maps import BLENDER_UNIT, DepthMap
from scene.readers.info import photo_size
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
    info = readers.CameraInfo(**values)
    assert info._fields == FIELDS == tuple(values) == tuple(info._asdict())
    assert readers.CameraInfo(*values.values())._asdict() == info._asdict() == values
    assert (len(info), info[0], info[-1], info[9:11]) == (12, 3, True, (160, 120))
    uid, R, *_, is_test = info
    assert (uid, R, is_test) == (3, values["R"], True)
    assert (info.fx, info.fy) == (readers.fov2focal(0.8, 160), readers.fov2focal(0.6, 120))
    assert (info.cx, info.cy) == (80, 60)
    assert info.image is None and info.mask is None and info.depth is None and not info.ignore_alpha
    old = {name: value for name, value in values.items() if name not in ("depth_params", "depth_path", "is_test")}
    of_2023 = readers.CameraInfo(**old, image=Image.new("RGB", (40, 30)))
    assert photo_size(of_2023) == (40, 30) and (of_2023.depth_path, of_2023.is_test) == ("", False)
    with pytest.raises(dataclasses.FrozenInstanceError):
        info.width = 5
    with pytest.raises(TypeError, match="needs width, and FovX or fx"):
        readers.CameraInfo(3, np.eye(3), np.zeros(3), FovY=0.6, width=160, height=120)
    with pytest.raises(TypeError, match="needs height"):
        readers.CameraInfo(3, np.eye(3), np.zeros(3), 0.6, 0.8, width=160)


def test_replacing_a_field_keeps_what_belongs_together():
    exact = readers.CameraInfo(1, np.eye(3), np.zeros(3), fx=123.456, fy=78.9, cx=70.5, width=160, height=120)
    again = dataclasses.replace(exact, T=np.ones(3))
    assert (again.fx, again.FovX, again.cx, again.cy) == (123.456, readers.focal2fov(123.456, 160), 70.5, 60)
    info = readers.CameraInfo(**_values(), cx=70.0, mask="mask", file_size=(320, 240))
    assert info._replace(FovX=0.5).fx == readers.fov2focal(0.5, 160)
    assert info._replace(fx=100.0).FovX == readers.focal2fov(100.0, 160)
    half = info._replace(width=80, height=60)
    assert (half.FovX, half.FovY) == (info.FovX, info.FovY)
    np.testing.assert_allclose((half.fx, half.fy, half.cx, half.cy), np.array([info.fx, info.fy, 70, 60]) / 2)
    assert (half.mask, half.file_size) == ("mask", (320, 240))
    other = info._replace(image_path="none/b.png", image_name="b.png")
    assert (other.image_path, other.image_name, other.cx) == ("none/b.png", "b.png", 70)
    assert photo_size(other) == (160, 120)  # of another photo, which is missing


def test_a_scene_made_of_the_references_fields():
    cloud = readers.BasicPointCloud(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 3)))
    views = [readers.CameraInfo(**_values())]
    scene = readers.SceneInfo(cloud, views, [], {"translate": np.zeros(3), "radius": np.float32(2.5)}, "a.ply")
    assert scene._fields == (
        *("point_cloud", "train_cameras", "test_cameras", "nerf_normalization", "ply_path", "is_nerf_synthetic"),
    )
    assert scene.extent == 2.5 and type(scene.extent) is float
    assert not scene.is_nerf_synthetic and not scene.offset.any()
    changed = scene._replace(test_cameras=views, is_nerf_synthetic=True)
    assert changed.test_cameras is views and changed.is_nerf_synthetic and changed.point_cloud is cloud
    assert readers.SceneInfo(*scene)._asdict() == scene._asdict()


# Points and sizes


def test_plys_go_both_ways(tmp_path):
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(256, 3)), np.repeat(np.arange(256)[:, None], 3, axis=1)
    readers.storePly(str(tmp_path / "a.ply"), xyz, rgb)
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    kinds = [(p.name, p.val_dtype) for p in vertices.properties]
    assert kinds == [(n, "f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [
        (n, "u1") for n in ("red", "green", "blue")
    ]
    cloud = readers.fetchPly(str(tmp_path / "a.ply"))
    assert isinstance(cloud, readers.BasicPointCloud) and cloud.points.dtype == np.float32
    np.testing.assert_array_equal(cloud.points, xyz.astype(np.float32))
    np.testing.assert_array_equal(cloud.colors, rgb / 255.0)
    assert not cloud.normals.any() and cloud.normals.shape == (256, 3)
    # Colours survive the truncation of the way back.
    readers.storePly(tmp_path / "b.ply", cloud.points, cloud.colors * 255)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    readers.storePly(tmp_path / "c.ply", xyz[:2], [[127.9, -3, 300]] * 2)
    np.testing.assert_array_equal(readers.fetchPly(tmp_path / "c.ply").colors[0] * 255, [127, 0, 255])
    with pytest.raises(UserError, match="no point cloud"):
        readers.fetchPly(tmp_path / "none.ply")


def test_the_norm_is_the_plain_rule():
    rng = np.random.default_rng(0)
    infos = [SimpleNamespace(R=np.linalg.qr(rng.normal(size=(3, 3)))[0], T=rng.normal(size=3)) for _ in range(9)]
    infos[4].T = infos[4].T + 900  # which stands apart
    centers = np.array([-info.R @ info.T for info in infos])
    norm = readers.getNerfppNorm(infos)
    np.testing.assert_allclose(norm["translate"], -centers.mean(axis=0))
    assert norm["radius"] == pytest.approx(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    assert readers.getNerfppNorm(infos[:1])["radius"] == 0
    skewed = SimpleNamespace(R=2 * infos[0].R, T=infos[0].T)  # of a scaled pose, which the matrix's inverse counts in
    np.testing.assert_allclose(readers.getNerfppNorm([skewed])["translate"], infos[0].R @ infos[0].T / 2)
    assert readers.scene_extent(infos) < norm["radius"] / 10


# COLMAP


def _same(view: readers.CameraInfo, other: readers.CameraInfo) -> None:
    np.testing.assert_allclose(view.R, other.R, atol=1e-14)
    np.testing.assert_array_equal(view.T, other.T)
    for name in ("uid", "FovX", "FovY", "fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(view, name) == getattr(other, name), name
    assert Path(view.image_path) == Path(other.image_path)


def test_a_colmap_scene_in_the_form_of_2024(colmap_scene, cache_folder):
    before = folder_state(colmap_scene)
    assert readers.sceneLoadTypeCallbacks["Colmap"] is readers.readColmapSceneInfo
    info = readers.readColmapSceneInfo(str(colmap_scene), None, "", True, False)
    ours = readers.read_scene(colmap_scene, "images", True)
    assert [c.image_name for c in info.train_cameras] == [c.image_name for c in ours.train_cameras]
    assert [c.image_name for c in info.test_cameras] == [c.image_name for c in ours.test_cameras]
    for view, other in zip(info.train_cameras + info.test_cameras, ours.train_cameras + ours.test_cameras, strict=True):
        _same(view, other)
        assert type(view.image_path) is str and os.path.isfile(view.image_path)
        assert view.is_test == other.is_test
        assert (view.depth_path, view.depth_params) == ("", None)
    assert [view.is_test for view in info.test_cameras] == [True] * 3 and not info.is_nerf_synthetic
    assert info.nerf_normalization["radius"] == pytest.approx(ours.extent)
    np.testing.assert_allclose(
        info.nerf_normalization["translate"], readers.getNerfppNorm(info.train_cameras)["translate"]
    )
    np.testing.assert_array_equal(info.point_cloud.colors.astype(np.float32), ours.point_cloud.colors)
    assert type(info.ply_path) is str and Path(info.ply_path).is_relative_to(cache_folder)
    np.testing.assert_array_equal(readers.fetchPly(info.ply_path).points, info.point_cloud.points)
    assert folder_state(colmap_scene) == before


def test_the_hold_of_a_colmap_scene(colmap_scene):
    names = [c.image_name for c in readers.readColmapSceneInfo(colmap_scene, "images", "", False, False).train_cameras]
    assert len(names) == 17 and names == sorted(names)
    info = readers.readColmapSceneInfo(
        path=colmap_scene, images="images", depths="", eval=True, train_test_exp=False, llffhold=5
    )
    assert [c.image_name for c in info.test_cameras] == names[::5]
    info = readers.readColmapSceneInfo(colmap_scene, "images", "", True, True)
    assert [c.image_name for c in info.train_cameras] == names
    assert [c.image_name for c in info.train_cameras if c.is_test] == names[::8]
    with pytest.raises(UserError, match="test.txt"):
        readers.readColmapSceneInfo(colmap_scene, "images", "", True, False, 0)
    (colmap_scene / "sparse" / "0" / "test.txt").write_text(f"{names[2]}\n{names[11]}\nother.png\n")
    info = readers.readColmapSceneInfo(colmap_scene, "images", "", True, False, 0)
    assert [c.image_name for c in info.test_cameras] == [names[2], names[11]] and len(info.train_cameras) == 15
    with pytest.raises(UserError, match="all 17 photos"):
        readers.readColmapSceneInfo(colmap_scene, "images", "", True, False, 1)


def test_a_colmap_scene_in_the_form_of_2023(colmap_scene):
    stems = sorted(path.stem for path in (colmap_scene / "images").rglob("*.png"))
    for info in (
        readers.readColmapSceneInfo(colmap_scene, None, True, 4),
        readers.readColmapSceneInfo(colmap_scene, eval=True),
    ):
        hold = 4 if len(info.test_cameras) == 5 else 8
        assert [c.image_name for c in info.test_cameras] == stems[::hold]
        assert [c.image_name for c in info.train_cameras] == [stem for i, stem in enumerate(stems) if i % hold]


def _model(scene: Path) -> tuple[dict, dict]:
    folder = scene / "sparse" / "0"
    return (
        colmap_loader.read_extrinsics_binary(folder / "images.bin"),
        colmap_loader.read_intrinsics_binary(folder / "cameras.bin"),
    )


def test_views_of_single_files(colmap_scene):
    images, cameras = _model(colmap_scene)
    ours = {view.image_name: view for view in readers.read_scene(colmap_scene, "images", False).train_cameras}
    views = readers.readColmapCameras(images, cameras, None, str(colmap_scene / "images"), "", [])
    assert [view.image_name for view in views] == [image.name for image in images.values()]
    for view in views:
        _same(view, ours[view.image_name])
        assert (view.depth_params, view.depth_path, view.is_test) == (None, "", False)
    old = readers.readColmapCameras(images, cameras, str(colmap_scene / "images"))
    assert [view.image_name for view in old] == [Path(view.image_path).stem for view in views]
    by_name = readers.readColmapCameras(
        cam_extrinsics=images, cam_intrinsics=cameras, images_folder=colmap_scene / "nowhere"
    )
    assert [photo_size(view) for view in by_name] == [(96, 64)] * 17  # poses do not need the photos


# Blender and nerfstudio


def test_a_blender_scene_in_both_forms(blender_scene, cache_folder):
    before = folder_state(blender_scene)
    assert readers.sceneLoadTypeCallbacks["Blender"] is readers.readNerfSyntheticInfo
    info = readers.readNerfSyntheticInfo(str(blender_scene), True, "", True)
    ours = readers.read_scene(blender_scene, "", True)
    for view, other in zip(info.train_cameras + info.test_cameras, ours.train_cameras + ours.test_cameras, strict=True):
        _same(view, other)
        assert (view.image_name, view.is_test) == (other.image_name, other.is_test)
    assert [view.is_test for view in info.test_cameras] == [True, True]
    assert info.is_nerf_synthetic and ours.is_nerf_synthetic
    assert len(info.point_cloud.points) == 100_000 and np.abs(info.point_cloud.points).max() <= 1.3
    np.testing.assert_array_equal(info.point_cloud.colors, 127 / 255)
    assert Path(info.ply_path).is_relative_to(cache_folder)
    joined = readers.readNerfSyntheticInfo(blender_scene, False, "", False)
    assert [view.is_test for view in joined.train_cameras] == [False] * 4 + [True] * 2 and not joined.test_cameras
    assert len(readers.readNerfSyntheticInfo(str(blender_scene), True, True, ".png").test_cameras) == 2
    assert folder_state(blender_scene) == before


def test_one_camera_file_in_both_forms(blender_scene):
    views = readers.readCamerasFromTransforms(str(blender_scene), "transforms_test.json", "", False, True)
    assert [(view.image_name, view.is_test, view.uid) for view in views] == [("r_0", True, 0), ("r_1", True, 1)]
    old = readers.readCamerasFromTransforms(str(blender_scene), "transforms_test.json", True, ".png")
    assert [(view.image_name, view.is_test) for view in old] == [("r_0", False), ("r_1", False)]
    deep = readers.readCamerasFromTransforms(blender_scene, "transforms_test.json", "/depths", False, True)
    assert [view.depth_path for view in deep] == ["/depths/r_0.png", "/depths/r_1.png"]
    assert deep[0].depth == DepthMap(Path("/depths/r_0.png"), BLENDER_UNIT) and deep[0].depth_params is None
    with pytest.raises(UserError, match="transforms_other.json"):
        readers.readCamerasFromTransforms(blender_scene, "transforms_other.json", "", False, False)
