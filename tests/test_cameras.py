"""Matrices of a view against the formulas and pycolmap, its target, and cameras of records and loaders of others."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from reference_records import CameraOf2024
from scipy.spatial.transform import Rotation
from synthetic import FOCAL, make_colmap_scene

import train
from scene.cameras import Camera, MiniCam
from scene.dataset_readers import CameraInfo
from scene.readers.colmap import read_colmap
from utils import camera_utils
from utils.graphics_utils import (
    focal2fov,
    fov2focal,
    getProjectionMatrix,
    getWorld2View,
    getWorld2View2,
    projection,
    world_to_camera,
)
from utils.system_utils import UserError


def _info(path: Path = Path("none.png"), **changes) -> CameraInfo:
    info = CameraInfo(
        uid=7,
        R=Rotation.from_euler("xyz", [20, -35, 60], degrees=True).as_matrix(),
        T=np.array([0.3, -0.2, 4.0]),
        fx=210.0,
        fy=190.0,
        cx=80.0,
        cy=60.0,
        width=160,
        height=120,
        image_path=path,
        image_name=path.name,
        file_size=(160, 120),
    )
    return replace(info, **changes)


def _camera(info: CameraInfo, size: tuple[int, int] | None = None) -> Camera:
    return Camera(info, size or info.file_size, 3)


def _pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixel positions, centres at integers, computed from the matrix as the rasterizer does."""
    rows = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    clip = rows @ camera.full_proj_transform.double().numpy()
    ndc = clip[:, :2] / clip[:, 3:]
    return ((ndc + 1) * [camera.image_width, camera.image_height] - 1) / 2


def test_matrices_are_the_formulas_transposed():
    info = _info()
    camera = _camera(info)
    V = np.eye(4)
    V[:3, :3], V[:3, 3] = info.R.T, info.T
    n, f = 0.01, 100.0
    P = np.zeros((4, 4))
    P[0, 0], P[1, 1] = 1 / math.tan(camera.FoVx / 2), 1 / math.tan(camera.FoVy / 2)
    P[2, 2], P[2, 3], P[3, 2] = f / (f - n), -f * n / (f - n), 1
    # Values up to 10 are rounded to float32 once.
    for got, wanted in (
        (camera.world_view_transform, V.T),
        (camera.projection_matrix, P.T),
        (camera.full_proj_transform, V.T @ P.T),
        (camera.camera_center, np.linalg.inv(V.T)[3, :3]),
    ):
        assert got.dtype == torch.float32 and got.is_contiguous()
        np.testing.assert_allclose(got.numpy(), wanted, rtol=6e-8, atol=1e-7)
    assert (camera.uid, camera.colmap_id) == (3, 7)
    np.testing.assert_array_equal(world_to_camera(info.R, info.T), V)
    np.testing.assert_allclose(projection(n, f, camera.FoVx, camera.FoVy).numpy(), P, rtol=1e-15)
    for got, wanted in (
        (getWorld2View(info.R, info.T), V),
        (getWorld2View2(info.R, info.T), V),
        (getProjectionMatrix(n, f, camera.FoVx, camera.FoVy).numpy(), P),
    ):
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, wanted.astype(np.float32))


def test_what_is_read_follows_the_place():
    """A matrix is made where it is first read, even if somebody has assigned R before, or renders in inference mode."""
    camera, other = _camera(_info()), _info(R=np.eye(3), T=np.array([1.0, 2.0, 3.0]))
    wanted = _camera(other)
    names = ("world_view_transform", "full_proj_transform", "camera_center", "projection_matrix")
    assert not torch.equal(camera.full_proj_transform, wanted.full_proj_transform)
    camera.place(other.R, other.T)
    camera.R = _info().R
    with torch.inference_mode():
        read = [getattr(camera, name) for name in names]
    assert all(torch.equal(one, getattr(wanted, name)) for one, name in zip(read, names, strict=True))
    np.testing.assert_array_equal(np.concatenate([one.numpy().ravel() for one in read]), camera.numbers)
    assert not any(one.is_inference() for one in read) and read[0] is camera.world_view_transform
    with pytest.raises(AttributeError, match="'Camera' object has no attribute 'nothing'"):
        _ = camera.nothing


@pytest.mark.parametrize("size", [1.0, 1.7])  # 1.7: the matrix of a scaled pose, no rotation
def test_a_camera_is_moved_and_scaled_about_the_origin(size):
    info = _info()
    translate, scale = np.array([1.0, -2.0, 0.5]), 3.0
    R = info.R * size
    V = np.eye(4)
    V[:3, :3], V[:3, 3] = R.T, info.T
    pose = np.linalg.inv(V)
    pose[:3, 3] = (pose[:3, 3] + translate) * scale
    np.testing.assert_allclose(getWorld2View2(R, info.T, translate, scale), np.linalg.inv(pose), rtol=1e-6, atol=1e-6)
    info = replace(info, R=R)
    for moved, there in ((Camera(info, (8, 6), 0, trans=translate, scale=scale), pose),
                         (Camera(info, (8, 6), 0), np.linalg.inv(V))):  # fmt: skip
        np.testing.assert_allclose(moved.camera_center.numpy(), there[:3, 3], rtol=1e-6)
        rigid = np.linalg.inv(there) / [[size], [size], [size], [1]]  # a camera divides the scale of its pose out
        np.testing.assert_allclose(moved.world_view_transform.T.numpy(), rigid, rtol=1e-6, atol=1e-6)
    assert (moved.trans == 0).all() and moved.scale == 1


def test_field_of_view_is_the_models_at_every_size():
    info = _info()
    small = _camera(info, (53, 40))
    assert small.FoVx == focal2fov(210.0, 160) == 2 * math.atan(160 / 420)
    assert small.FoVy == 2 * math.atan(120 / 380)
    assert fov2focal(small.FoVx, 160) == pytest.approx(210.0)
    assert (small.fx, small.fy) == (pytest.approx(210 * 53 / 160), pytest.approx(190 * 40 / 120))
    assert (small.cx, small.cy) == (pytest.approx(26.5), pytest.approx(20))


@pytest.mark.parametrize("size", [(96, 64), (48, 32), (60, 51)])
@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (FOCAL, 0.9 * FOCAL, 41.0, 37.5)), ("SIMPLE_PINHOLE", (FOCAL, 50.0, 30.0))]
)
def test_projection_agrees_with_pycolmap(tmp_path, size, model, params):
    reconstruction = make_colmap_scene(tmp_path, model=model, params=params, views=3)
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    infos = read_colmap(tmp_path, "images", False).train_cameras
    assert len(infos) == 3
    for info in infos:
        camera = _camera(info, size)
        image = reconstruction.find_image_with_name(info.image_name)
        theirs = np.array([image.project_point(point) for point in points]) * np.array(size) / (96, 64)
        # COLMAP has pixel centres at .5. The bound is that of float32 matrices over some 100 pixels.
        np.testing.assert_allclose(_pixels(camera, points) + 0.5, theirs, atol=1e-4)
        np.testing.assert_allclose(camera.camera_center.numpy(), image.projection_center(), rtol=1e-6, atol=1e-6)


def test_target_with_alpha_lies_on_the_background(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    pixels[0, :, 3], pixels[1, :, 3] = 0, 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    camera = _camera(_info(tmp_path / "a.png"), (8, 6))
    background = torch.tensor([0.2, 0.5, 1.0])
    alpha = pixels[..., 3:] / 255.0
    wanted = pixels[..., :3] / 255.0 * alpha + background.numpy() * (1 - alpha)
    target = camera.target(background)
    assert target.dtype == torch.float32
    np.testing.assert_allclose(target.permute(1, 2, 0).numpy(), wanted, atol=2e-7)  # three roundings below 1
    assert torch.equal(target[:, 0], background[:, None].expand(3, 8))
    assert torch.equal(target[:, 1], camera.original_image[:, 1])
    np.testing.assert_allclose(camera.alpha_mask[0].numpy(), alpha[..., 0], atol=6e-8)
    assert torch.equal(camera.target(background), target)  # the stored image is not changed


def test_mini_camera_finds_its_centre():
    camera = _camera(_info())
    mini = MiniCam(
        160, 120, camera.FoVy, camera.FoVx, 0.01, 100.0, camera.world_view_transform, camera.full_proj_transform
    )
    torch.testing.assert_close(mini.camera_center, camera.camera_center, rtol=1e-5, atol=1e-5)
    assert (mini.image_width, mini.image_height, mini.FoVy) == (160, 120, camera.FoVy)


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
