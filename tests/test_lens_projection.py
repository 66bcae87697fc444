"""Gaussians through lenses: where pycolmap shows their means, the covariance of the Jacobian, and all gradients."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, rasterize, reference
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.lens import Lens, lens_of
from diff_gaussian_rasterization.scene import scene_arguments
from lenses import colmap_camera, make_lens
from rasterizer_tools import BOTH_AND_GPU

WIDTH, HEIGHT = 96, 64
KNOWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE",
         "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")  # fmt: skip
PANORAMA = Lens("equirectangular", (WIDTH / (2 * math.pi), HEIGHT / math.pi), (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5))


def lens(model: str) -> Lens:
    if model == "panorama":
        return PANORAMA
    found = make_lens(model, 28.0 if "FISHEYE" in model else 60.0, WIDTH, HEIGHT)
    return lens_of(model, found.params)


def settings(of: Lens | None, dtype: torch.dtype, device: str = "cpu", **more) -> GaussianRasterizationSettings:
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.det(turn)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3], view[3, :3] = turn, torch.tensor([0.1, -0.2, 0.3])
    center = -(turn @ view[3, :3])
    projection = view.clone()  # is not read
    view, projection, center = (t.to(device, dtype) for t in (view, projection, center))
    background = torch.tensor([0.2, 0.4, 0.6], dtype=dtype, device=device)
    return GaussianRasterizationSettings(
        HEIGHT, WIDTH, 0.8, 0.6, background, 1.0, view, projection, 1, center, False, False, lens=of
    )._replace(**more)


def gaussians(
    of: Lens, camera: GaussianRasterizationSettings, count: int, seed: int = 0, spread: float = 0.85
) -> dict[str, torch.Tensor]:
    """Drawn all over that share of the lens's field, at distances of 1 to 5."""
    rng = np.random.default_rng(seed)
    field = min(of.field(WIDTH, HEIGHT), math.pi - 0.3)
    angle = np.arctan(field) if of.chart == "perspective" else field
    theta, phi = spread * angle * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * math.pi, count)
    away = rng.uniform(1, 5, (count, 1))
    view = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1) * away
    matrix = camera.viewmatrix.double().cpu()
    means = (torch.from_numpy(view) - matrix[3, :3]) @ torch.linalg.inv(matrix[:3, :3])
    draw = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=draw, dtype=torch.float64)  # noqa: E731
    drawn = {
        "means": means,
        "opacities": normal(count, 1),
        "scales": torch.log(0.04 * torch.from_numpy(away)) + 0.4 * normal(count, 3),
        "rotations": normal(count, 4),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.2 * normal(count, 3, 3),
    }
    like = camera.viewmatrix
    return {name: values.to(like.device, like.dtype) for name, values in drawn.items()}


def everywhere(of: Lens, camera: GaussianRasterizationSettings, count: int) -> dict[str, torch.Tensor]:
    """Far outside of the image, too; each fifth is so large that its footprint reaches into it."""
    values = gaussians(of, camera, count, spread=1.7 if of.chart == "perspective" else 1.0)
    values["scales"][::5] += 3
    values["opacities"] -= 2
    return values


def draw(camera: GaussianRasterizationSettings, values: dict[str, torch.Tensor], by=rasterize, **more):
    values = dict(values)
    means, opacities = values.pop("means"), values.pop("opacities")
    return by(means, torch.zeros_like(means), opacities, camera, raw=True, **values, **more)


def projected(camera: GaussianRasterizationSettings, values: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    return OPERATORS.project(*scene_arguments(Gaussians(**values), camera, True))


@pytest.mark.parametrize("model", KNOWN)
def test_means_lie_where_pycolmap_shows_them(model):
    of = lens(model)
    camera = settings(of, torch.float64)
    values = gaussians(of, camera, 500)
    splats, _, _, counts, *_ = projected(camera, values)
    view = values["means"] @ camera.viewmatrix[:3, :3] + camera.viewmatrix[3, :3]
    found = make_lens(model, 28.0 if "FISHEYE" in model else 60.0, WIDTH, HEIGHT)
    pixels = torch.from_numpy(np.asarray(colmap_camera(found).img_from_cam(view.numpy()))) - 0.5
    shown = (counts > 0) & (view[:, 2] > 0)  # pycolmap shows nothing behind
    assert shown.sum() > 200
    assert (splats[shown, :2] - pixels[shown]).abs().max() < 1e-9


def test_a_lens_without_distortion_is_a_pinhole():
    focal, center = (60.0, 61.0), (47.0, 33.0)
    camera = settings(Lens("perspective", focal, center), torch.float64)
    pinhole = torch.zeros(4, 4, dtype=torch.float64)
    pinhole[0, 0], pinhole[1, 1] = 2 * focal[0] / WIDTH, 2 * focal[1] / HEIGHT
    pinhole[2, 0], pinhole[2, 1] = (2 * center[0] + 1) / WIDTH - 1, (2 * center[1] + 1) / HEIGHT - 1
    pinhole[2, 3] = 1
    plain = camera._replace(
        lens=None,
        projmatrix=camera.viewmatrix @ pinhole,
        tanfovx=WIDTH / (2 * focal[0]),
        tanfovy=HEIGHT / (2 * focal[1]),
    )
    values = everywhere(camera.lens, camera, 2000)
    leaves = {name: v.clone().requires_grad_() for name, v in values.items()}
    others = {name: v.clone().requires_grad_() for name, v in values.items()}
    one, two = draw(camera, leaves), draw(plain, others)
    assert (one.color - two.color).abs().max() < 1e-11
    (one.color**2).sum().backward(), (two.color**2).sum().backward()
    for name in values:
        torch.testing.assert_close(leaves[name].grad, others[name].grad, rtol=1e-9, atol=1e-9)


def of_nearest_copies(splats, rows, width, alphas=reference.blend.alphas):
    """The alphas of a panorama, of which each tile shows the nearest copy of a splat."""
    left = torch.arange(width) // 16 * 16 - splats.pixel[:, :1]
    turns = (left >= width / 2).int() - (left < -width / 2).int()
    by_turns = [alphas(splats._replace(pixel=splats.pixel + torch.tensor([turn * width, 0])), rows, width)
                for turn in (-1, 0, 1)]  # fmt: skip
    return sum((turns == turn)[:, None] * by_turns[turn + 1] for turn in (-1, 0, 1))


@pytest.mark.parametrize(
    ("model", "antialiasing"),
    [
        ("PINHOLE", False), ("OPENCV", True), ("FULL_OPENCV", False), ("OPENCV_FISHEYE", True),
        ("THIN_PRISM_FISHEYE", False), ("panorama", True),
    ],
)  # fmt: skip
def test_images_and_gradients_are_the_oracles(model, antialiasing, monkeypatch):
    if model == "panorama":
        monkeypatch.setattr(reference.blend, "alphas", of_nearest_copies)
    of, width, height = lens(model).scaled(0.5, 0.5), WIDTH // 2, HEIGHT // 2  # for speed
    camera = settings(of, torch.float64, antialiasing=antialiasing, image_width=width, image_height=height)
    values = everywhere(of, camera, 600)
    weight = torch.randn(3, height, width, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ours, theirs = ({name: v.clone().requires_grad_() for name, v in values.items()} for _ in range(2))
    one = draw(camera, ours, want_inverse_depth=True)
    two = draw(camera, theirs, by=reference.render, cut=1e-9)
    keep = ~two.near_cut
    assert keep.double().mean() > 0.99
    for out in (one, two):
        ((weight * out.color).sum(0) + out.inverse_depth[0])[keep].sum().backward()
    assert ((one.color - two.color) * keep).abs().max() < 1e-11
    for name in values:
        torch.testing.assert_close(ours[name].grad, theirs[name].grad, rtol=1e-9, atol=1e-9)


@BOTH_AND_GPU
@pytest.mark.parametrize("model", ["FULL_OPENCV", "THIN_PRISM_FISHEYE", "panorama"])
def test_single_precision_agrees_with_double(model, device, dtype):
    of = lens(model)
    exact, camera = settings(of, torch.float64), settings(of, dtype, device)
    values = everywhere(of, exact, 2000)
    leaves = {name: v.to(device, dtype).clone().requires_grad_() for name, v in values.items()}
    precise = {name: v.clone().requires_grad_() for name, v in values.items()}
    one, two = draw(camera, leaves), draw(exact, precise)
    assert (one.color.double().cpu() - two.color).abs().max() < 2e-4
    one.color.square().sum().backward(), two.color.square().sum().backward()
    for name, leaf in leaves.items():
        scale = precise[name].grad.abs().max()
        assert (leaf.grad.double().cpu() - precise[name].grad).abs().max() < 2e-3 * scale, name


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
    camera = settings(PANORAMA, dtype, device, antialiasing=antialiasing)
    values = gaussians(PANORAMA, camera, 600)
    values["scales"][::7] += 1
    weight = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    weight = weight.to(device, dtype)
    plain, turn = ({name: v.clone().requires_grad_() for name, v in values.items()} for _ in range(2))
    one, two = draw(camera, plain).color, draw(turned(camera, 32), turn).color.roll(-32, 2)  # whole tiles
    crossing = projected(turned(camera, 32), values)[0][:, 2] < 0
    assert 20 < crossing.sum() < 300
    rounding = 1e-9 if dtype == torch.float64 else 2e-4
    assert (one - two).abs().max() < rounding
    size = HEIGHT, WIDTH
    splats, *tiles, _ = projected(camera, values)  # each stage by itself, as several processes call them
    instances, ranges, *_ = OPERATORS.bin(splats, *tiles, *size, False)
    staged = OPERATORS.blend(splats, instances, ranges, camera.bg, *size, False, False)[0]
    assert torch.equal(staged, one) if device == "cpu" else (staged - one).abs().max() < rounding
    (weight * one).sum().backward(), (weight * two).sum().backward()
    for name in values:
        scale = plain[name].grad.abs().max()
        assert (plain[name].grad - turn[name].grad).abs().max() < 10 * rounding * scale, name


@BOTH_AND_GPU
def test_gaussians_at_a_panoramas_poles_are_shown_with_finite_gradients(device, dtype):
    camera = settings(PANORAMA, dtype, device)._replace(viewmatrix=torch.eye(4, dtype=dtype, device=device))
    values = gaussians(PANORAMA, camera, 60)
    aside = torch.logspace(0, -50, 60, dtype=torch.float64)  # from a radian to nothing that float32 has
    values["means"] = torch.stack([aside, torch.tensor([2.0, -2.0] * 30), 0.5 * aside], 1).to(device, dtype)
    leaves = {name: v.clone().requires_grad_() for name, v in values.items()}
    image = draw(camera, leaves).color
    image.square().sum().backward()
    assert image.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())
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
    camera = settings(strong, torch.float64)
    beyond = (torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64) - camera.viewmatrix[3, :3]) @ torch.linalg.inv(
        camera.viewmatrix[:3, :3]
    )
    values = gaussians(strong, camera, 1) | {"means": beyond}
    assert projected(camera, values)[3].item() == 0


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"focal": (math.nan, 60.0)}, "finite numbers and focal lengths above 0"),
        ({"focal": (0.0, 60.0)}, "finite numbers and focal lengths above 0"),
        ({"chart": "fisheye"}, "chart 'fisheye' is none of perspective, equidistant, equirectangular"),
    ],
)
def test_a_lens_that_is_none_is_named(wrong, said):
    camera = settings(PANORAMA, torch.float64)
    values = gaussians(PANORAMA, camera, 3)
    with pytest.raises(ValueError, match=said):
        projected(camera._replace(lens=PANORAMA._replace(**wrong)), values)
