"""Matrices of a view against the formulas and against pycolmap, and its target image."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from synthetic import FOCAL, make_colmap_scene

from scene.cameras import Camera, MiniCam
from scene.dataset_readers import CameraInfo
from scene.readers.colmap import read_colmap
from scene.view import View
from utils.graphics_utils import (
    focal2fov,
    fov2focal,
    geom_transform_points,
    getProjectionMatrix,
    getWorld2View,
    getWorld2View2,
    projection,
    world_to_camera,
)


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
    """It is made where it is first read, even if somebody has assigned R then, or renders in inference mode."""
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


def test_points_are_transformed_and_divided():
    matrix = np.random.default_rng(0).uniform(0.5, 1, (4, 4))
    points = np.random.default_rng(1).uniform(0, 1, (5, 3))
    moved = np.concatenate([points, np.ones((5, 1))], axis=1) @ matrix
    got = geom_transform_points(torch.from_numpy(points), torch.from_numpy(matrix))
    np.testing.assert_allclose(got.numpy(), moved[:, :3] / (moved[:, 3:] + 1e-7), rtol=1e-14)


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


def test_target_without_alpha_stays_uint8(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    camera = _camera(_info(tmp_path / "a.png"), (8, 6))
    target = camera.target(torch.ones(3))
    assert target.dtype == torch.uint8 and torch.equal(camera.alpha_mask, torch.ones(1, 6, 8))
    np.testing.assert_array_equal(target.permute(1, 2, 0).numpy(), pixels)
    assert torch.equal(camera.original_image, target.float() / 255)


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


def test_a_plain_view_is_what_a_camera_is_without_changes(tmp_path):
    Image.fromarray(np.full((60, 80, 3), 50, np.uint8)).save(tmp_path / "a.png")
    info, black = _info(tmp_path / "a.png"), torch.zeros(3)
    for view, camera in (
        (View(info, (80, 60), 3), _camera(info, (80, 60))),
        (View(info, (80, 60), 3).at_size((40, 30)), _camera(info, (80, 60)).at_size((40, 30))),
    ):
        np.testing.assert_array_equal(view.numbers, camera.numbers)
        assert torch.equal(view.target(black), camera.target(black)) and view.ground_truth(black)[1] is None
        assert isinstance(camera, View) and view.has_dataset_pictures and camera.has_dataset_pictures
        assert (view.depth_reliable, view.target_inverse_depth) == (False, None)
    assert not hasattr(view, "original_image") and view.undecoded == []


def test_mini_camera_finds_its_centre():
    camera = _camera(_info())
    mini = MiniCam(
        160, 120, camera.FoVy, camera.FoVx, 0.01, 100.0, camera.world_view_transform, camera.full_proj_transform
    )
    torch.testing.assert_close(mini.camera_center, camera.camera_center, rtol=1e-5, atol=1e-5)
    assert (mini.image_width, mini.image_height, mini.FoVy) == (160, 120, camera.FoVy)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_mini_camera_on_a_gpu_needs_no_library_of_solvers(monkeypatch):
    inverted = []
    plain = torch.inverse
    monkeypatch.setattr(torch, "inverse", lambda matrix: (inverted.append(matrix.device.type), plain(matrix))[1])
    view = torch.eye(4, device="cuda")
    view[3, :3] = torch.tensor([1.0, 2.0, 3.0])
    mini = MiniCam(160, 120, 0.6, 0.9, 0.01, 100.0, view, view)
    assert inverted == ["cpu"] and mini.camera_center.tolist() == [-1, -2, -3] and mini.camera_center.is_cuda
