"""Coarse to fine: smaller views, their pictures, and when they are taken."""

import argparse
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from PIL import Image
from trainings import PYRAMID as SMALL_AT_FIRST
from trainings import before_steps, train_on

from arguments import ModelParams
from gaussian_renderer import render
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.images.sizes import shrink_mask, shrink_photo, shrink_values
from scene.images.store import InMemory
from scene.readers.info import CameraInfo
from splatting.features.time_budget import Sizes, smaller
from splatting.features.time_budget_schedule import PYRAMID, Block, Decided, DecidedSchedule


def _scene(folder: Path, out: Path, **options: object) -> tuple[Scene, GaussianModel]:
    args = ModelParams(argparse.ArgumentParser()).extract(
        argparse.Namespace(source_path=str(folder), model_path=str(out), **options)
    )
    gaussians = GaussianModel(args.sh_degree)
    return Scene(args, gaussians, shuffle=False), gaussians


def _schedule(length: int) -> DecidedSchedule:
    """A schedule with smaller views at first."""
    block = Block(length, 0.0, 1 / length, 0.0)
    return DecidedSchedule(Decided(length, [block], length, 0.0, "pyramid", PYRAMID))


def _slow_average(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """(C,H,W) averaged over areas by fractions of pixels: each pixel is divided into height by width first."""
    channels, rows, columns = pixels.shape
    divided = pixels.repeat(height, axis=1).repeat(width, axis=2)
    return divided.reshape(channels, height, rows, width, columns).mean(axis=(2, 4))


@pytest.mark.parametrize("size", [(12, 8), (7, 5), (11, 7), (24, 15), (1, 1)])
def test_a_smaller_photo_is_the_area_average(size):
    pixels = torch.randint(0, 256, (3, 15, 24), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    wanted = _slow_average(pixels.double().numpy(), *size)
    got = shrink_photo(pixels, size)
    assert got.dtype == torch.uint8 and np.abs(got.numpy() - wanted).max() <= 0.5 + 1e-9
    values = pixels[:1].float() / 7
    np.testing.assert_allclose(shrink_values(values, size), _slow_average(values.double().numpy(), *size), rtol=1e-6)


def test_alpha_weights_colours_and_masks_keep_out_what_they_touch():
    pixels = torch.zeros(4, 4, 4, dtype=torch.uint8)
    pixels[:, :2, :2] = torch.tensor([200, 100, 50, 255], dtype=torch.uint8)[:, None, None]
    pixels[:3, 0, 0] = 255  # of the same weight as the three others
    pixels[:3, :2, 2:] = 90  # transparent, so it has no say
    small = shrink_photo(pixels, (2, 2))
    assert small[:, 0, 0].tolist() == [214, 139, 101, 255] and small[:, 0, 1].tolist() == [0, 0, 0, 0]
    mixed = shrink_photo(pixels, (1, 1))
    assert mixed[:, 0, 0].tolist() == [214, 139, 101, 64]
    assert shrink_photo(pixels, (1, 1), mask_alpha=True)[3].tolist() == [[0]]
    mask = torch.full((1, 4, 6), 255, dtype=torch.uint8)
    mask[0, 3, 5] = 0
    assert shrink_mask(mask, (3, 2))[0].tolist() == [[255, 255, 255], [255, 255, 0]]
    assert shrink_mask(mask, (4, 2))[0].tolist() == [[255] * 4, [255] * 3 + [0]]


@pytest.mark.parametrize("factor", [2, 4])
def test_a_smaller_view_is_that_of_a_scene_with_smaller_photos(colmap_scene, tmp_path, factor):
    whole, gaussians = _scene(colmap_scene, tmp_path / "a", resolution=1)
    small, _ = _scene(colmap_scene, tmp_path / "b", resolution=factor)
    for view, wanted in list(zip(whole.getTrainCameras(), small.getTrainCameras(), strict=True))[:3]:
        got = view.at_size((wanted.image_width, wanted.image_height))
        assert (got.cx, got.cy) == pytest.approx((wanted.cx, wanted.cy)) and got.cx != got.image_width / 2
        assert (got.fx, got.fy, got.uid, got.FoVx) == (wanted.fx, wanted.fy, wanted.uid, wanted.FoVx)
        black = torch.zeros(3)
        with torch.no_grad():
            images = [render(camera, gaussians, pipeline(), black)["render"] for camera in (got, wanted)]
        assert torch.equal(*images) and images[0].std() > 0.01
        assert got.target(black).shape == images[0].shape
        photo = Image.open(view.image_path).convert("RGB").resize(got._size, Image.Resampling.BOX)
        difference = got.target(black).int() - torch.from_numpy(np.asarray(photo).transpose(2, 0, 1).copy()).int()
        assert difference.abs().max() <= 1  # Pillow rounds twice
        assert got.undecoded == [] and got.counted_pixels is None and got.counts_all_pixels
        assert view._size == (96, 64) and view.target(black).shape == (3, 64, 96)


def test_masks_depth_maps_and_columns_are_smaller_too(colmap_scene, tmp_path):
    scene, _ = _scene(colmap_scene, tmp_path / "a", resolution=1)
    mask = np.full((64, 96), 255, dtype=np.uint8)
    mask[:33, :16] = 0
    for camera in scene.getTrainCameras():
        path = colmap_scene / "masks" / f"{camera.image_name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)
    scene, _ = _scene(colmap_scene, tmp_path / "b", resolution=1, masks="masks")
    view = scene.getTrainCameras()[0]
    view.columns = slice(0, 45)
    small = view.at_size((24, 16))
    counted = torch.ones(1, 16, 24, dtype=torch.bool)
    counted[:, :9, :4] = False  # row 8 touches a masked pixel
    assert torch.equal(small.counted_pixels, counted) and not small.counts_all_pixels
    assert small.columns == slice(0, 11)  # of the twelfth, a quarter does not count
    assert small.alpha_mask.shape == (1, 16, 24) and small.alpha_mask[..., 11:].sum() == 0
    right = view.at_size((96, 64))
    view.columns = slice(45, 96)
    assert view.at_size((24, 16)).columns == slice(12, 24) and right.columns == slice(0, 45)
    view = _photo(0.1, depth=InMemory(torch.arange(96.0).expand(1, 64, 96).contiguous()))
    small = view.at_size((48, 32))
    assert small.depth_reliable and torch.equal(small.target_inverse_depth[0, 5], torch.arange(48) * 2 + 0.5)
    assert torch.equal(small.depth_mask, torch.ones(1, 32, 48))


def test_levels_are_of_the_schedule_and_small_views_stay():
    levels = ((0.0, 4.0), (0.1, 2.0), (0.25, 1.0))
    assert levels == PYRAMID
    sizes = Sizes(_schedule(1000), None)
    factors = [sizes.factor_at(t) for t in range(1, 1001)]
    assert [factors.index(f) + 1 for f in (4.0, 2.0, 1.0)] == [1, 100, 250] and factors == sorted(factors)[::-1]
    assert [t for t in range(2, 1001) if sizes.factor_at(t - 1) != sizes.factor_at(t)] == [100, 250]
    view = argparse.Namespace(image_width=200, image_height=100)
    assert smaller(view, 4.0) == (64, 32) and smaller(view, 2.0) == (100, 50)
    assert smaller(argparse.Namespace(image_width=20, image_height=10), 4.0) == (20, 10)


def test_views_are_made_once_a_level_and_assigned_pictures_are_left_alone(colmap_scene, tmp_path):
    scene, _ = _scene(colmap_scene, tmp_path, resolution=1)
    first, second, third = scene.getTrainCameras()[:3]
    sizes = Sizes(_schedule(1000), scene.images)
    third.original_image = torch.zeros(3, 64, 96)
    small = sizes.view(first, 1)
    assert small._size == (48, 32) and small is sizes.view(first, 2) and sizes.view(third, 2) is third
    assert not sizes.needs(first) and sizes.needs(second)
    assert sizes.view(first, 250) is first and sizes.needs(first)
    limited, _ = _scene(colmap_scene, tmp_path / "limited", resolution=1, images_to_load=3)
    sizes, view = Sizes(_schedule(1000), limited.images), limited.getTrainCameras()[0]
    assert sizes.view(view, 1) is not sizes.view(view, 1) and sizes.needs(view)


def _photo(cycles: float, depth: InMemory | None = None) -> Camera:
    """A view whose photo is a wave of so many cycles per pixel."""
    wave = torch.sin(2 * torch.pi * cycles * torch.arange(96).float()).expand(3, 64, 96) / 4 + 0.5
    place = {"uid": 0, "R": np.eye(3), "T": np.zeros(3), "FovX": 1.0, "FovY": 1.0, "width": 96, "height": 64}
    info = CameraInfo(**place, image_name="a", image=InMemory(wave.contiguous()), depth=depth)
    return Camera(info, (96, 64), 0)


OPTIONS = ["--eval", "--no_curve", "--test_iterations", -1, "--iterations", 60, "--densify_from_iter", 5,
           "--densification_interval", 10, "--densify_grad_threshold", 1e-4]  # fmt: skip


def _train(scene: Path, out: Path, *more: object) -> dict[int, bytes]:
    return train_on(scene, out, "--disable_viewer", *OPTIONS, *more)


def test_a_coarse_to_fine_training_begins_with_small_views(colmap_scene, tmp_path, monkeypatch):
    sizes = []
    before_steps(monkeypatch, lambda step: sizes.append((step.iteration, step.camera.image_width)))
    saved = _train(colmap_scene, tmp_path / "a", *SMALL_AT_FIRST)
    widths = [width for _, width in sizes]
    assert set(widths) == {48, 96} and widths == sorted(widths)
    assert _train(colmap_scene, tmp_path / "few", *SMALL_AT_FIRST, "--images_to_load", 4) == saved
    assert _train(colmap_scene, tmp_path / "none", "--schedule", 60) != saved
