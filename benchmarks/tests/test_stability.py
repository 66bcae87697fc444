"""Stiff and extreme cases, each held to its own bound (tests/workloads/stability_cases.py has the reasons)."""

import functools
import sys

import mpmath
import pytest
import torch
from diff_gaussian_rasterization import reference
from rasterizer_tools import gradients, leaves, one_splat, render

from benchmarks.accuracy import stability
from benchmarks.accuracy.runs import CPU_FLOAT, TEXTBOOK, kernels
from benchmarks.accuracy.stability import Judged, find_excess
from tests.workloads.splat_scenes import settings
from tests.workloads.stability_cases import CASES, Case, long_needles

BY_NAME = {case.name: case for case in CASES}


@functools.cache
def judged(case: Case) -> Judged:
    return Judged(case)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_case_is_within_its_bound(case, device):
    backends = [backend for backend in kernels() if backend.device == device]
    if not backends:
        pytest.skip("needs a GPU and a build with CUDA")
    assert case.bound.reason
    measured = judged(case)
    for backend in backends:
        assert find_excess(case, backend, measured, measured.result(backend)) == []


def test_the_bounds_could_fail():
    """The textbook's formulas, measured in the same way, exceed the bounds of the cases that they handle badly."""
    beyond = ["needles, axes 1 : 1e+07", "pancakes edge-on, antialiased", "needles of 300 to 2,000 px"]
    beyond += ["field of view 179 degrees", "zero quaternions", "viewing direction of no length"]
    for name in beyond:
        case = BY_NAME[name]
        result = judged(case).result(TEXTBOOK)
        assert result.worst("gradients", "stiff") > 4 * case.bound.gradient, name
    assert not judged(BY_NAME["nan in sh_dc"]).result(TEXTBOOK).finite


def test_the_oracle_itself_on_needles_a_million_pixels_long():
    """a c - b b would be off by 1e-16 (1e6)^4 of 0.3 (1e6)^2; the reference is mpmath with 60 digits."""
    make, cam = long_needles(1, 1e6, 1.1e6, (0.2, 0.3))
    parameters = make(torch.Generator().manual_seed(4)) | {"opacities": torch.tensor([[1.0]])}
    inputs = leaves(parameters, torch.float64)
    alpha = 1 - render(inputs, cam, function=reference.render).transmittance[0]
    rows, columns = torch.nonzero(alpha > 2 / 255, as_tuple=True)
    assert len(rows) > 20
    with mpmath.workdps(60):
        scales = [mpmath.mpf(v) for v in parameters["scales"][0].tolist()]
        mean, conic = _mean_and_conic(parameters, cam, scales)
        pixels = list(zip(columns.tolist(), rows.tolist(), strict=True))
        wanted = [float(_gaussian(pixel, mean, conic) / (1 + mpmath.exp(-1))) for pixel in pixels]
        # Take a sum of alphas over all pixels, and so its derivative by the logarithm of the needle's length and width.
        few = pixels[:: len(pixels) // 10]

        def total(k: int, value: mpmath.mpf) -> mpmath.mpf:
            shape = _mean_and_conic(parameters, cam, [*scales[:k], value, *scales[k + 1 :]])
            return sum(_gaussian(pixel, *shape) for pixel in few) / (1 + mpmath.exp(-1))

        slopes = [float(mpmath.diff(functools.partial(total, k), scales[k])) for k in range(3)]
    # The conic is exact to 1e-16 times length over width, 2e6; then come some ten operations on values of 1e6.
    wanted = torch.tensor(wanted, dtype=torch.float64)
    torch.testing.assert_close(alpha[rows, columns].detach(), wanted, rtol=1e-8, atol=0)
    alpha[[y for _, y in few], [x for x, _ in few]].sum().backward()
    slopes = torch.tensor(slopes, dtype=torch.float64)
    torch.testing.assert_close(inputs["scales"].grad[0], slopes, rtol=0, atol=1e-8 * float(slopes.abs().max()))


@pytest.mark.parametrize("scale", [1e-10, 1e-25])
def test_the_oracle_itself_on_tiny_scales(scale):
    """Far below the dilation, alpha at a pixel hangs on the covariance C linearly: dC = 2 s (J R)(J R)^T ds."""
    parameters = one_splat(0.02, -0.01, scale=scale, opacity=0.9)
    parameters["rotations"] = torch.tensor([[0.8, 0.4, 0.4, -0.2]], dtype=torch.float64)
    cam = settings(16, 16)
    inputs = leaves(parameters)
    alpha = 1 - render(inputs, cam, function=reference.render, raw=False).transmittance[0]
    alpha[7, 7].backward()
    with mpmath.workdps(80):

        def value(k: int, s: mpmath.mpf) -> mpmath.mpf:
            scales = [mpmath.log(s if axis == k else mpmath.mpf(scale)) for axis in range(3)]
            return mpmath.mpf(0.9) * _gaussian((7, 7), *_mean_and_conic(parameters, cam, scales))

        step = mpmath.mpf(scale) * mpmath.mpf(10) ** -20
        slopes = [float((value(k, scale + step) - value(k, scale - step)) / (2 * step)) for k in range(3)]
    torch.testing.assert_close(inputs["scales"].grad[0], torch.tensor(slopes, dtype=torch.float64), rtol=1e-12, atol=0)


def _mean_and_conic(parameters: dict, cam, log_scales: list) -> tuple[mpmath.matrix, mpmath.matrix]:
    """Pixel mean (2) and inverse 2D covariance (2, 2) of the first raw Gaussian, for a camera at the origin."""
    q = [mpmath.mpf(v) for v in parameters["rotations"][0].tolist()]
    w, i, j, k = (v / mpmath.sqrt(sum(u * u for u in q)) for v in q)
    turn = [[1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)]]
    turn += [[2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)]]
    turn += [[2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)]]
    axes = mpmath.matrix(turn) * mpmath.diag([mpmath.exp(s) for s in log_scales])
    *across, z = (mpmath.mpf(v) for v in parameters["means"][0].tolist())
    mean, jacobian = [], []
    for axis, (size, tan) in enumerate(((cam.image_width, cam.tanfovx), (cam.image_height, cam.tanfovy))):
        tan, ray = mpmath.mpf(tan), across[axis] / z
        mean.append(((mpmath.mpf(cam.projmatrix[axis, axis].item()) * ray + 1) * size - 1) / 2)
        limit = mpmath.mpf(1.3) * tan
        row = [0, 0, -max(min(ray, limit), -limit)]
        row[axis] = 1
        jacobian.append([size / (2 * tan) / z * v for v in row])
    half = mpmath.matrix(jacobian) * axes
    return mpmath.matrix(mean), mpmath.inverse(half * half.T + mpmath.mpf(0.3) * mpmath.eye(2))


def _gaussian(pixel: tuple[int, int], mean: mpmath.matrix, conic: mpmath.matrix) -> mpmath.mpf:
    x, y = pixel[0] - mean[0], pixel[1] - mean[1]
    return mpmath.exp(-(conic[0, 0] * x * x + 2 * conic[0, 1] * x * y + conic[1, 1] * y * y) / 2)


def test_equal_scales_are_not_turned():
    """The gradient is exactly zero: Adam divides by its size, so noise would turn Gaussians at the full rate."""
    problem = BY_NAME["three equal scales"].problem()
    for antialiasing in (False, True):
        cam = problem.camera._replace(antialiasing=antialiasing)
        got = gradients({name: t[problem.stiff] for name, t in problem.parameters.items()}, cam)
        assert not got["d rotations"].any() and got["d scales"].any()


def test_at_most_2350_splats_blend_on_a_pixel():
    problem = BY_NAME["50,000 splats on one pixel"].problem()
    blended = gradients(problem.parameters, problem.camera)["d opacities"].count_nonzero()
    # At the least alpha, ln(1e-4) / ln(1 - 1/255) = 2,344 would.
    assert 2000 < blended <= 2350


def test_the_benchmark_prints_its_verdict_which_fails_where_a_bound_is_passed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["stability.py", "--only", "17 x 31"])
    stability.main()
    assert "\nVerdict: stable. All 1 cases are finite and within their bounds on CPU" in capsys.readouterr().out
    # The textbook's formulas stand in for ours.
    monkeypatch.setattr(stability, "kernels", lambda: [CPU_FLOAT._replace(render=TEXTBOOK.render)])
    for only in ("edge-on", "no such case"):
        monkeypatch.setattr(sys, "argv", ["stability.py", "--only", only])
        with pytest.raises(SystemExit) as stopped:
            stability.main()
        assert stopped.value.code == 1 and "\nVerdict: NOT STABLE. Of " in capsys.readouterr().out
