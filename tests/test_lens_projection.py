"""Gaussians through lenses: where pycolmap shows their means, the covariance of the Jacobian, and all gradients."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, rasterize
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


def draw(camera: GaussianRasterizationSettings, values: dict[str, torch.Tensor], **more):
    values = dict(values)
    means, opacities = values.pop("means"), values.pop("opacities")
    return rasterize(means, torch.zeros_like(means), opacities, camera, raw=True, **values, **more)


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
    values = gaussians(camera.lens, camera, 200, spread=0.6)  # within the clamp of a pinhole's Jacobian
    leaves = {name: v.clone().requires_grad_() for name, v in values.items()}
    others = {name: v.clone().requires_grad_() for name, v in values.items()}
    one, two = draw(camera, leaves), draw(plain, others)
    assert (one.color - two.color).abs().max() < 1e-11
    (one.color**2).sum().backward(), (two.color**2).sum().backward()
    for name in values:
        torch.testing.assert_close(leaves[name].grad, others[name].grad, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("antialiasing", [False, True], ids=["plain", "antialiasing"])
@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "panorama"])
def test_gradients_are_those_of_differences(model, antialiasing):
    of = lens(model)
    camera = settings(of, torch.float64, antialiasing=antialiasing)
    values = gaussians(of, camera, 6, seed=3)
    weight = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def loss(*given: torch.Tensor) -> torch.Tensor:
        drawn = draw(camera, dict(zip(values, given, strict=True)), want_inverse_depth=True)
        return (weight * drawn.color).sum() + drawn.inverse_depth.sum()

    leaves = [v.clone().requires_grad_() for v in values.values()]
    loss(*leaves).backward()
    for name, leaf in zip(values, leaves, strict=True):
        step, numeric = 1e-6, torch.zeros_like(leaf)
        for index in np.ndindex(*leaf.shape):
            ends = []
            for sign in (1, -1):
                moved = [v.clone() for v in values.values()]
                moved[list(values).index(name)][index] += sign * step
                ends.append(loss(*moved))
            numeric[index] = (ends[0] - ends[1]) / (2 * step)
        scale = numeric.abs().max()
        assert (leaf.grad - numeric).abs().max() < 2e-6 * scale + 1e-8, name


@BOTH_AND_GPU
@pytest.mark.parametrize("model", ["FULL_OPENCV", "THIN_PRISM_FISHEYE", "panorama"])
def test_single_precision_agrees_with_double(model, device, dtype):
    of = lens(model)
    exact, camera = settings(of, torch.float64), settings(of, dtype, device)
    values = gaussians(of, exact, 300)
    leaves = {name: v.to(device, dtype).clone().requires_grad_() for name, v in values.items()}
    precise = {name: v.clone().requires_grad_() for name, v in values.items()}
    one, two = draw(camera, leaves), draw(exact, precise)
    assert (one.color.double().cpu() - two.color).abs().max() < 2e-4
    one.color.square().sum().backward(), two.color.square().sum().backward()
    for name, leaf in leaves.items():
        scale = precise[name].grad.abs().max()
        assert (leaf.grad.double().cpu() - precise[name].grad).abs().max() < 2e-3 * scale, name


def test_the_field_ends_where_the_distortion_turns_back():
    strong = Lens("perspective", (60.0, 60.0), (47.5, 31.5), radial=(-0.5, 0.0, 0.0, 0.0))
    assert strong.field(WIDTH, HEIGHT) == pytest.approx(math.sqrt(1 / 1.5))  # r (1 - r^2 / 2)
    none = Lens("perspective", (60.0, 60.0), (47.5, 31.5))
    assert none.field(WIDTH, HEIGHT) == pytest.approx(1.3 * math.hypot(48, 32) / 60, rel=1e-3)
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
