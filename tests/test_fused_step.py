"""Fused calls of a training step against the same step in plain parts: the trajectory is equal byte for byte."""

import numpy as np
import pytest
import torch
from fused_ssim import fused_l1_ssim
from torch import Tensor

import train
from gaussian_renderer import render
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians import adam
from scene.readers.point_cloud import write_point_cloud

ITERATIONS = 90


def _render(*arguments, clamp: bool = True, **named) -> dict[str, Tensor]:
    return render(*arguments, **named)


def _loss(
    image: Tensor, target: Tensor, weight: float, mask: None, columns: None, clamp: bool
) -> tuple[Tensor, Tensor]:
    assert image.min() >= 0 and image.max() <= 1 and mask is columns is None and clamp
    l1, ssim = fused_l1_ssim(image, target)
    return (1.0 - weight) * l1 + weight * (1.0 - ssim), l1


def _target(camera: Camera, background: Tensor) -> Tensor:
    scaled = camera._pixels() / 255
    color, alpha = scaled[:3], scaled[3:]
    return color * alpha + background[:, None, None] * (1 - alpha)


def _observe(gaussians: GaussianModel, points: Tensor, radii: Tensor) -> None:
    torch.maximum(gaussians.max_radii2D, radii, out=gaussians.max_radii2D)
    x, y, _ = points.grad.numpy().T
    length = torch.from_numpy(np.sqrt(x * x + y * y))  # torch's root is not always rounded correctly
    gaussians.xyz_gradient_accum += torch.where(radii > 0, length, 0.0)[:, None]
    gaussians.denom += (radii > 0)[:, None]


def _adam(values, gradients, means, squares, steps, rates, beta1, beta2, eps, columns, *guard) -> None:
    for one in zip(values, gradients, means, squares, steps, rates, columns, strict=True):
        *tensors, rate, count = ([item] for item in one)
        torch.ops.diff_gaussian_rasterization.adam_(*tensors, rate, beta1, beta2, eps, count)


@pytest.mark.parametrize("background", [["--random_background"], ["-w"]], ids=["random", "white"])
def test_fused_and_plain_steps_go_the_same_way(blender_scene, tmp_path, monkeypatch, background):
    monkeypatch.setattr("splatting.training.run.SH_INTERVAL", 25)
    random = np.random.default_rng(0)
    write_point_cloud(blender_scene / "points3d.ply", random.uniform(-1, 1, (300, 3)), random.random((300, 3)))
    options = ["--densify_from_iter", "20", "--densification_interval", "20", "--densify_grad_threshold", "5e-5"]
    options += ["--opacity_reset_interval", "50", "--test_iterations", "-1", "--eval", *background]
    models = []
    for fused in (True, False):
        if not fused:
            monkeypatch.setattr("splatting.training.steps.plain.render", _render)
            monkeypatch.setattr("splatting.training.objective.photometric_loss", _loss)
            monkeypatch.setattr(Camera, "target", _target)
            monkeypatch.setattr(GaussianModel, "observe", _observe)
            monkeypatch.setattr(adam, "adam_", _adam)
            options.append("--plain_step")
        out = tmp_path / str(fused)
        train.main(["-s", str(blender_scene), "-m", str(out), "--iterations", str(ITERATIONS), *options])
        models.append((out / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply").read_bytes())
    assert models[0] == models[1]
    assert len(models[0]) > 300 * 62 * 4 * 1.1  # densification took part
