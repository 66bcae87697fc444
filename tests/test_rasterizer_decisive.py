"""Decisive Gaussians: those that a pixel blends, and those that end one."""

import math

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, decisive
from rasterizer_tools import BOTH_AND_GPU, leaves, one_splat, pick, render, together
from torch import Tensor

from tests.workloads.splat_scenes import SplatScene, frustum, move_camera, settings

SIZE = (75, 53)


def _crowd(n: int = 1500) -> SplatScene:
    """Opaque splats, so many that most are hidden; some are behind the camera or beside the image."""
    scene = frustum(n, *SIZE, 2.0, seed=12)
    scene.parameters["opacities"] += 3.0
    scene.parameters["means"][::40] *= -1.0
    return scene


def _decisive(parameters: dict[str, Tensor], camera: GaussianRasterizationSettings, raw: bool = True) -> Tensor:
    rest = dict(parameters)
    return decisive(rest.pop("means"), rest.pop("opacities"), camera, **rest, raw=raw)


def _blended(parameters: dict[str, Tensor], camera: GaussianRasterizationSettings, raw: bool = True) -> Tensor:
    """The Gaussians with weight in some pixel, (N,) bool, from the gradient of the colours, a sum of weights."""
    colors = torch.full_like(parameters["means"], 0.5)
    inputs = leaves({name: t for name, t in parameters.items() if not name.startswith("sh_")} | {"colors": colors})
    render(inputs, camera, raw=raw).color.sum().backward()
    return inputs["colors"].grad[:, 0] > 0


@BOTH_AND_GPU
@pytest.mark.parametrize("antialiasing", [False, True])
def test_without_the_others_no_bit_changes(antialiasing, device, dtype):
    scene = _crowd()
    parameters = {name: t.to(device, dtype) for name, t in scene.parameters.items()}
    camera = move_camera(settings(*SIZE, dtype, antialiasing=antialiasing), device)
    mask = _decisive(parameters, camera)
    assert 0.2 * len(mask) < mask.sum() < 0.5 * len(mask)
    before, after = (render(p, camera) for p in (parameters, pick(parameters, mask)))
    for name in ("color", "transmittance", "inverse_depth"):
        assert torch.equal(getattr(before, name), getattr(after, name)), name
    blended = _blended(parameters, camera)
    assert not (blended & ~mask).any()
    for i in blended.nonzero().flatten()[::30].tolist():  # and each of them is necessary
        others = mask.clone()
        others[i] = False
        assert not torch.equal(render(pick(parameters, others), camera).color, before.color)


@BOTH_AND_GPU
def test_one_that_only_ends_pixels_is_needed(device, dtype):
    """Two leave 0.0004. The third would leave less than 0.0001, so it ends every pixel and excludes the fourth."""
    opacities = (0.98, 0.98, 0.9, 0.02)
    scene = together(*(one_splat(z=1.0 + k, opacity=a, scale=50.0) for k, a in enumerate(opacities)))
    parameters = {name: t.to(device, dtype) for name, t in scene.items()}
    camera = move_camera(settings(20, 20, dtype), device)
    assert _blended(parameters, camera, raw=False).tolist() == [True, True, False, False]
    mask = _decisive(parameters, camera, raw=False)
    assert mask.tolist() == [True, True, True, False]
    images = [render(pick(parameters, rows), camera, raw=False).color for rows in ([0, 1, 2, 3], [0, 1, 2], [0, 1, 3])]
    assert torch.equal(images[0], images[1]) and not torch.equal(images[0], images[2])


@BOTH_AND_GPU
def test_none_and_one_that_is_not_finite(device, dtype):
    parameters = {name: t.to(device, dtype) for name, t in together(one_splat(), one_splat(z=2.0)).items()}
    camera = move_camera(settings(20, 20, dtype), device)
    assert _decisive(pick(parameters, []), camera, raw=False).shape == (0,)
    parameters["means"][0, 0] = math.nan
    assert _decisive(parameters, camera, raw=False).tolist() == [False, True]
