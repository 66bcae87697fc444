"""Cameras of records: loadCam and the lists that a scene makes with it, also when other code has replaced them."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from reference_records import CameraOf2024
from scipy.spatial.transform import Rotation
from synthetic import FakeGaussians, make_colmap_scene, options_of

import scene as scene_package
import train
from scene import Scene
from scene.cameras import Camera
from scene.dataset_readers import CameraInfo
from utils import camera_utils
from utils.system_utils import UserError

RNG = np.random.default_rng(0)


@pytest.fixture
def record(tmp_path: Path) -> CameraOf2024:
    """A record of a photo of 40x24 pixels, and of a depth map of 20x12."""
    Image.fromarray(RNG.integers(0, 256, (24, 40, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(RNG.integers(0, 65536, (12, 20), dtype=np.uint16)).save(tmp_path / "depth.png")
    R = Rotation.from_euler("xyz", [20, -35, 60], degrees=True).as_matrix()
    path = str(tmp_path / "a.png")
    return CameraOf2024(5, R, np.array([0.1, 0.2, 3.0]), 0.5, 0.8, None, path, "a.png", "", 80, 48, False)


def _args(**changes: object) -> SimpleNamespace:
    return SimpleNamespace(**{"resolution": 2, "data_device": "cuda"} | changes)


def test_a_record_of_the_reference_becomes_a_camera(record):
    camera = camera_utils.loadCam(_args(), 3, record, 1.0)
    assert type(camera) is Camera is camera_utils.Camera
    assert (camera.uid, camera.colmap_id, camera.image_name) == (3, 5, "a.png")
    assert (camera.image_width, camera.image_height, camera.FoVx, camera.FoVy) == (20, 12, 0.8, 0.5)
    wanted = np.asarray(Image.open(record.image_path).resize((20, 12))).transpose(2, 0, 1) / np.float32(255)
    np.testing.assert_array_equal(camera.original_image.cpu().numpy(), wanted)
    with Image.open(record.image_path) as image:
        given = Camera((20, 12), 5, record.R, record.T, 0.8, 0.5, None, image, None, "a.png", 3)
    for name in ("world_view_transform", "projection_matrix", "full_proj_transform", "camera_center"):
        assert torch.equal(getattr(camera, name), getattr(given, name))
    assert camera.projection_matrix[2, 0] == camera.projection_matrix[2, 1] == 0
    assert not camera.depth_reliable and camera.columns is None


def test_a_scale_in_a_record_of_the_reference_is_divided_out(record):
    scaled = record._replace(R=4 * record.R, T=4 * record.T)
    assert camera_utils.camera_to_JSON(3, scaled) == camera_utils.camera_to_JSON(3, record)
    assert camera_utils.loadCam(_args(), 3, record, 2.0).image_width == 10
    with pytest.raises(UserError, match="none.png"):
        camera_utils.loadCam(_args(), 3, record._replace(image_path="none.png"), 1.0)


def test_a_record_may_hold_its_image(record):
    image = Image.fromarray(RNG.integers(0, 256, (24, 40, 3), dtype=np.uint8))
    held = SimpleNamespace(**record._asdict() | {"image": image})
    camera = camera_utils.loadCam(_args(resolution=1), 0, held, 1.0)
    assert camera.undecoded == [] and (camera.image_width, camera.image_height) == (40, 24)
    np.testing.assert_array_equal(camera.target(torch.zeros(3)).permute(1, 2, 0).cpu().numpy(), np.asarray(image))


@pytest.mark.parametrize("synthetic", [False, True])
@pytest.mark.parametrize("scale", [None, 0.5, 9.0])
def test_a_named_depth_map_has_its_kinds_unit(record, tmp_path, synthetic, scale):
    params = None if scale is None else {"scale": scale, "offset": 0.125, "med_scale": 1.0}
    record = record._replace(depth_path=str(tmp_path / "depth.png"), depth_params=params)
    camera = camera_utils.loadCam(_args(), 0, record, 1.0, synthetic)
    values = np.asarray(Image.open(record.depth_path)) / (512.0 if synthetic else 65536.0)
    wanted = values if scale is None else values * scale + 0.125
    np.testing.assert_allclose(camera.invdepthmap[0].cpu().numpy(), wanted, rtol=1e-6)
    assert camera.depth_reliable is (scale != 9.0) and camera.depth_mask.all() == (scale != 9.0)
    with pytest.raises(UserError, match="none.png"):
        camera_utils.loadCam(_args(), 0, record._replace(depth_path="none.png"), 1.0)


def test_halves_by_the_record_and_the_list(record):
    for options, is_test, in_test_list, wanted in (
        (_args(), True, True, None),
        (_args(train_test_exp=True), False, False, None),
        (_args(train_test_exp=True), True, False, slice(0, 10)),
        (_args(train_test_exp=True), True, True, slice(10, 20)),
    ):
        info = record._replace(is_test=is_test)
        (camera,) = camera_utils.cameraList_from_camInfos([info], 1.0, options, False, in_test_list)
        assert camera.columns == wanted


def test_entries_of_plain_records(record):
    plain = SimpleNamespace(**{name: getattr(record, name) for name in ("R", "T", "FovX", "FovY")})
    plain.width, plain.height, plain.image_name = 80, 48, "b"
    for camera in (plain, record, CameraInfo(*record)):
        entry = camera_utils.camera_to_JSON(4, camera)
        assert list(entry) == ["id", "img_name", "width", "height", "position", "rotation", "fy", "fx"]
        assert (entry["id"], entry["width"], entry["height"]) == (4, 80, 48)
        assert entry["fx"] == pytest.approx(40 / math.tan(0.4)) and entry["fy"] == pytest.approx(24 / math.tan(0.25))
        pose = np.linalg.inv(np.vstack([np.column_stack([record.R.T, record.T]), [0, 0, 0, 1]]))
        np.testing.assert_allclose(entry["position"], pose[:3, 3])
        np.testing.assert_allclose(entry["rotation"], pose[:3, :3], atol=1e-12)
    plain.fx, plain.fy = 100.0, 90.0
    entry = camera_utils.camera_to_JSON(4, plain)
    assert (entry["fx"], entry["fy"]) == (100.0, 90.0)


def _theirs(args, id, cam_info, resolution_scale, is_nerf_synthetic, is_test_dataset):
    """A loadCam as other code writes it: it opens the photo, and calls Camera with the reference's arguments."""
    with Image.open(cam_info.image_path) as image:
        width = 24
        size = width, int(image.height / (image.width / width))
        return Camera(
            size, colmap_id=cam_info.uid, R=cam_info.R, T=cam_info.T, FoVx=cam_info.FovX, FoVy=cam_info.FovY,
            depth_params=None, image=image, invdepthmap=None, image_name=cam_info.image_name, uid=id,
            data_device=args.data_device, train_test_exp=args.train_test_exp, is_test_dataset=is_test_dataset,
            is_test_view=is_test_dataset,
        )  # fmt: skip


def _ply(scene: Path, out: Path, *more: str) -> bytes:
    options = "--iterations 20 --densify_from_iter 5 --densification_interval 5 -r 24 --test_iterations 10 --eval"
    train.main(["-s", str(scene), "-m", str(out), *options.split(), *more])
    return (out / "point_cloud" / "iteration_20" / "point_cloud.ply").read_bytes()


def test_cameras_of_a_replaced_loader_train_the_same_model(tmp_path, monkeypatch):
    # The reference's arguments cannot tell a principal point.
    make_colmap_scene(tmp_path / "scene", params=(110.0, 110.0, 48.0, 32.0), views=9)
    ours = _ply(tmp_path / "scene", tmp_path / "ours")
    called = []
    monkeypatch.setattr(camera_utils, "loadCam", lambda *a: called.append(a) or _theirs(*a))
    assert _ply(tmp_path / "scene", tmp_path / "theirs") == ours
    assert len(called) == 9 and sum(a[-1] for a in called) == 2  # in the test list
    _ply(tmp_path / "scene", tmp_path / "halves", "--train_test_exp")


def test_a_scene_leaves_cameras_of_another_class_as_they_are(colmap_scene, tmp_path, monkeypatch):
    foreign = SimpleNamespace(image_width=3, image_height=2)
    monkeypatch.setattr(camera_utils, "loadCam", lambda *_: foreign)
    options = options_of(colmap_scene, tmp_path / "out", eval=True, train_test_exp=True)
    made = Scene(options, FakeGaussians(), start=False)
    assert made.getTrainCameras() == [foreign] * 17 and made.getTestCameras() == [foreign] * 3
    assert vars(foreign) == {"image_width": 3, "image_height": 2}
    made.prefetch(made.getTrainCameras())
    assert len(made.images) == 0 and made.images.planned_bytes == 0


@pytest.mark.parametrize("place", [camera_utils, scene_package])
def test_a_scene_calls_what_replaces_our_functions(colmap_scene, tmp_path, monkeypatch, place):
    calls = []
    theirs = {
        "cameraList_from_camInfos": lambda *a: calls.append(a) or [("camera", len(a[0]))],
        "camera_to_JSON": lambda number, _: {"number": number},
    }
    for name, function in theirs.items():
        monkeypatch.setitem(vars(place), name, function)
    made = Scene(options_of(colmap_scene, tmp_path / "out"), FakeGaussians(), resolution_scales=[1.0, 2.0])
    assert [(a[1], *a[3:]) for a in calls] == [(1.0, False, False), (2.0, False, False), (1.0, False, True),
                                              (2.0, False, True)]  # fmt: skip
    assert made.getTrainCameras(2.0) == [("camera", 17)] and made.getTestCameras() == [("camera", 0)]
    assert (tmp_path / "out" / "cameras.json").read_text().startswith('[{"number": 0}, {"number": 1}')
