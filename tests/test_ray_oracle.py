"""The oracle's Gaussians on rays: the definition by brute force, EWA in the limit, and the rays of lenses' pixels."""

import math

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, reference
from diff_gaussian_rasterization.lens import Lens, lens_of
from diff_gaussian_rasterization.reference.lens import rays
from lenses import colmap_camera, make_lens
from rasterizer_tools import render
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from tests.workloads.splat_scenes import settings

WIDTH, HEIGHT = 48, 32
FISHEYE = Lens("equidistant", (14.0, 14.0), (23.0, 15.0), radial=(0.05, -0.01, 0.0, 0.0))
PANORAMA = Lens("equirectangular", (WIDTH / (2 * math.pi), HEIGHT / math.pi), (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5))
PERSPECTIVE = Lens("perspective", (24.0, 24.0), (23.0, 15.0), tangential=(0.003, -0.002))


def camera(lens: Lens | None, **more) -> GaussianRasterizationSettings:
    focal, center = (24.0, 24.0) if lens is None else lens.focal, (23.0, 15.0)
    principal = tuple((2 * at + 1) / size - 1 for at, size in zip(center, (WIDTH, HEIGHT), strict=True))
    plain = settings(WIDTH, HEIGHT, torch.float64, fov=2 * math.atan(WIDTH / 2 / focal[0]), principal=principal)
    return plain._replace(lens=lens, bg=torch.zeros(3, dtype=torch.float64), projection="ray", **more)


def one(mean: tuple[float, ...], scales: tuple[float, ...], turn: int = 0) -> dict[str, torch.Tensor]:
    """A white Gaussian of opacity 0.9, activated."""
    rotation = torch.randn(1, 4, generator=torch.Generator().manual_seed(turn), dtype=torch.float64)
    values = {"means": [mean], "opacities": [[0.9]], "scales": [scales], "colors": [[1.0, 1.0, 1.0]]}
    found = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    return found | {"rotations": rotation / rotation.norm()}


def alpha(values: dict[str, torch.Tensor], view: GaussianRasterizationSettings) -> torch.Tensor:
    return render(values, view, function=reference.render, raw=False).color[0]


def widened(values: dict[str, torch.Tensor], view: GaussianRasterizationSettings) -> np.ndarray:
    """The covariance in the view, grown by 0.3 px^2 in the two directions of equal depth that move one pixel each."""
    mean = values["means"][0].clone().requires_grad_()
    plain = view.lens or Lens("perspective", (24.0, 24.0), (23.0, 15.0))
    depth = (lambda p: p[2]) if plain.chart == "perspective" else torch.linalg.vector_norm
    to_image = torch.autograd.functional.jacobian(
        lambda p: torch.cat([reference.lens.pixels(plain, p), depth(p)[None]]), mean
    )
    along = torch.linalg.inv(to_image)[:, :2]
    RS = reference.shape.rotation_matrices(values["rotations"])[0] * values["scales"][0]
    return (RS @ RS.T + 0.3 * along @ along.T).detach().numpy()


CASES = {
    "ordinary": ((0.3, -0.2, 2.0), (0.1, 0.2, 0.3)),
    "on the axis": ((0.0, 0.0, 2.0), (0.1, 0.2, 0.3)),
    "large, and beside the image": ((2.0, 0.5, 2.0), (0.5, 0.3, 0.8)),
    "thin": ((-0.6, 0.4, 1.5), (1e-4, 0.3, 0.9)),
    "flat": ((-0.6, 0.4, 1.5), (0.0, 0.3, 0.5)),
    "around the camera": ((0.2, 0.1, 0.5), (0.4, 0.6, 0.5)),
    "behind a wide lens's camera": ((-0.9, 0.3, -0.5), (0.3, 0.2, 0.25)),
}


@pytest.mark.parametrize(
    "lens", [None, PERSPECTIVE, FISHEYE, PANORAMA], ids=["pinhole", "brown", "fisheye", "panorama"]
)
@pytest.mark.parametrize("case", CASES)
def test_alpha_is_the_largest_value_in_front_on_a_pixels_ray(case, lens):
    """Against SciPy's density, maximised along each ray; a panorama has all pixels, the others some."""
    values, view = one(*CASES[case]), camera(lens)
    found = alpha(values, view)
    if values["means"][0, 2] < 0 and lens in (None, PERSPECTIVE):
        assert found.max() == 0
        return
    mean = values["means"][0].numpy()
    density = multivariate_normal(mean, widened(values, view))
    peak = density.logpdf(mean)
    directions = rays(lens or Lens("perspective", (24.0, 24.0), (23.0, 15.0)), WIDTH, HEIGHT).numpy()
    brightest = np.unravel_index(int(found.argmax()), found.shape)
    for y, x in [brightest, *((y, x) for y in range(1, HEIGHT, 15) for x in range(2, WIDTH, 20))]:
        ray = directions[y, x]
        if not ray.any():
            assert found[y, x] == 0
            continue
        line = minimize_scalar(lambda t, ray=ray: -density.logpdf(t * ray), bracket=(0.0, 2.0), tol=1e-11)
        expected = 0.9 * math.exp(-line.fun - peak) if line.x > 0 else 0.0
        assert found[y, x] == pytest.approx(expected if expected >= 1 / 255 else 0.0, abs=1e-8)


@pytest.mark.parametrize("lens", [None, FISHEYE], ids=["pinhole", "fisheye"])
def test_small_gaussians_look_as_with_ewa(lens):
    """The difference falls with the size, down to the dilation's own: for a pinhole that is none."""
    for size, most in ((0.1, 0.08), (0.01, 0.01), (0.001, 0.01)):
        values = one((0.5, -0.3, 2.0), (size, 2 * size, size / 2))
        view = camera(lens)
        difference = (alpha(values, view) - alpha(values, view._replace(projection="ewa"))).abs().max()
        assert difference < (most if lens else 2 * size * most / 0.1), size


def test_given_covariances_are_those_of_scales_and_rotations():
    values, view = one((0.4, 0.1, 1.0), (0.3, 0.1, 0.5)), camera(FISHEYE)
    RS = reference.shape.rotation_matrices(values["rotations"]) * values["scales"][:, None]
    upper = (RS @ RS.transpose(1, 2))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    given = {name: values[name] for name in ("means", "opacities", "colors")} | {"cov3d": upper}
    assert (alpha(values, view) - alpha(given, view)).abs().max() < 1e-13


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_rays_are_pycolmaps(model):
    found = make_lens(model, 30.0, WIDTH, HEIGHT)
    ours = rays(lens_of(model, found.params), WIDTH, HEIGHT).reshape(-1, 3)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    theirs = colmap_camera(found).cam_ray_from_img(np.stack([x.ravel(), y.ravel()], 1) + 0.5)
    shown = ours.norm(dim=1) > 0
    assert shown.double().mean() > 0.9
    ours, theirs = ours[shown] / ours[shown].norm(dim=1, keepdim=True), torch.from_numpy(theirs)[shown]
    known = theirs.isfinite().all(1)  # pycolmap's fisheyes see nothing behind
    assert known.double().mean() > 0.9
    assert (ours[known] - theirs[known]).abs().max() < 1e-9


def test_the_ends_of_a_lens_show_nothing():
    folding = Lens("perspective", (24.0, 24.0), (23.0, 15.0), radial=(-0.5, 0.0, 0.0, 0.0))  # r (1 - r^2 / 2)
    directions = rays(folding, WIDTH, HEIGHT)
    radius = torch.hypot(*torch.meshgrid(torch.arange(HEIGHT) - 15.0, torch.arange(WIDTH) - 23.0, indexing="ij")) / 24
    assert torch.equal(directions.any(2), radius < math.sqrt(2 / 3) * 2 / 3)
    assert directions[15, 23].tolist() == [0, 0, 1]
