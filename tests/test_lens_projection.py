"""Gaussians through lenses: where pycolmap shows their means, and what has no seam, pole or end (oracle: its test)."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.lens import Lens
from lens_scenes import HEIGHT, PANORAMA, WIDTH, distorted, gaussians, lens, view_through
from lenses import colmap_camera
from rasterizer_tools import BOTH_AND_GPU, leaves, move_camera, ops, render, scene_arguments

KNOWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE",
         "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")  # fmt: skip


def projected(camera: GaussianRasterizationSettings, values: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    return ops.project(*scene_arguments(values, camera))


@pytest.mark.parametrize("model", KNOWN)
def test_means_lie_where_pycolmap_shows_them(model):
    camera = view_through(lens(model), torch.float64)
    values = gaussians(camera.lens, camera, 500)
    splats, _, _, counts, *_ = projected(camera, values)
    view = values["means"] @ camera.viewmatrix[:3, :3] + camera.viewmatrix[3, :3]
    pixels = torch.from_numpy(np.asarray(colmap_camera(distorted(model)).img_from_cam(view.numpy()))) - 0.5
    shown = (counts > 0) & (view[:, 2] > 0)  # pycolmap shows nothing behind
    assert shown.sum() > 200
    assert (splats[shown, :2] - pixels[shown]).abs().max() < 1e-9


def turned(camera: GaussianRasterizationSettings, columns: int) -> GaussianRasterizationSettings:
    """The camera of a panorama whose columns are moved to the right by so many."""
    angle = 2 * math.pi * columns / WIDTH
    turn = torch.eye(4, dtype=torch.float64, device=camera.viewmatrix.device)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = -math.sin(angle), math.sin(angle)
    return camera._replace(viewmatrix=(camera.viewmatrix.double() @ turn).to(camera.viewmatrix))


@BOTH_AND_GPU
@pytest.mark.parametrize("antialiasing", [False, True])
def test_a_panorama_has_no_seam(antialiasing, device, dtype):
    camera = move_camera(view_through(PANORAMA, dtype, antialiasing=antialiasing), device)
    values = gaussians(PANORAMA, camera, 600)
    values["scales"][::7] += 1
    weight = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    weight = weight.to(device, dtype)
    plain, turn = leaves(values), leaves(values)
    one, two = render(plain, camera).color, render(turn, turned(camera, 32)).color.roll(-32, 2)  # whole tiles
    crossing = projected(turned(camera, 32), values)[0][:, 2] < 0
    assert 20 < crossing.sum() < 300
    rounding = 1e-9 if dtype == torch.float64 else 2e-4
    assert (one - two).abs().max() < rounding
    size = HEIGHT, WIDTH
    splats, *tiles, _ = projected(camera, values)  # each stage by itself, as several processes call them
    instances, ranges, *_ = ops.bin(splats, *tiles, *size, False)
    staged = ops.blend(splats, instances, ranges, camera.bg, *size, False, False)[0]
    assert torch.equal(staged, one) if device == "cpu" else (staged - one).abs().max() < rounding
    (weight * one).sum().backward(), (weight * two).sum().backward()
    for name in values:
        scale = plain[name].grad.abs().max()
        assert (plain[name].grad - turn[name].grad).abs().max() < 10 * rounding * scale, name


@BOTH_AND_GPU
def test_gaussians_at_a_panoramas_poles_are_shown_with_finite_gradients(device, dtype):
    camera = move_camera(view_through(PANORAMA, dtype), device)
    camera = camera._replace(viewmatrix=torch.eye(4, dtype=dtype, device=device))
    values = gaussians(PANORAMA, camera, 60)
    aside = torch.logspace(0, -50, 60, dtype=torch.float64)  # from a radian to nothing that float32 has
    values["means"] = torch.stack([aside, torch.tensor([2.0, -2.0] * 30), 0.5 * aside], 1).to(device, dtype)
    inputs = leaves(values)
    image = render(inputs, camera).color
    image.square().sum().backward()
    assert image.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in inputs.values())
    assert (projected(camera, values)[3] > 0).all()  # they are shown, not left out


def test_the_field_ends_where_the_distortion_turns_back():
    strong = Lens("perspective", (60.0, 60.0), (47.5, 31.5), radial=(-0.5, 0.0, 0.0, 0.0))
    assert strong.field(WIDTH, HEIGHT) == pytest.approx(math.sqrt(1 / 1.5))  # r (1 - r^2 / 2)
    none = Lens("perspective", (60.0, 60.0), (47.5, 31.5))
    assert none.field(WIDTH, HEIGHT) == pytest.approx(1.3 * math.hypot(48, 32) / 60, rel=1e-3)
    assert none.numbers(WIDTH, HEIGHT)[1:3] == (math.inf, 1)
    assert strong.numbers(WIDTH, HEIGHT)[2] == pytest.approx(1.5)  # 1 / (1 - r^2 / 2) there
    folding = none._replace(tangential=(0.1, 0.0))  # r - 0.3 r^2 upwards
    assert folding.numbers(WIDTH, HEIGHT)[1] == pytest.approx((1 / 0.6) ** 2)
    camera = view_through(strong, torch.float64)
    beyond = torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64) - camera.viewmatrix[3, :3]
    means = beyond @ torch.linalg.inv(camera.viewmatrix[:3, :3])
    assert projected(camera, gaussians(strong, camera, 1) | {"means": means})[3].item() == 0
