"""Small models and options for tests of the model and of training."""

import argparse

import numpy as np
import pytest
import torch

from arguments import OptimizationParams, PipelineParams
from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import attributes
from utils.graphics_utils import BasicPointCloud

GROUPS = {group: attribute.field for group, attribute in attributes(0).items()}
STANDARD = tuple(attributes(0, further=False))  # the groups of the paper
FURTHER = tuple(group for group in GROUPS if group not in STANDARD)
needs_fused_step = pytest.mark.skipif(bool(FURTHER), reason="a model with further attributes takes plain steps")
needs_59_values = pytest.mark.skipif(bool(FURTHER), reason="the numbers of bytes are of the paper's attributes")


def options(**changes: object) -> argparse.Namespace:
    """Optimisation options with default values, except for `changes`."""
    return OptimizationParams(argparse.ArgumentParser()).extract(argparse.Namespace(**changes))


def pipeline(**changes: object) -> argparse.Namespace:
    """Pipeline options with default values, except for `changes`."""
    return PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace(**changes))


def cloud(count: int, seed: int = 0) -> BasicPointCloud:
    """`count` points roughly in a unit ball."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)).astype(np.float32) * 0.4
    return BasicPointCloud(points, rng.random((count, 3)).astype(np.float32), np.zeros_like(points))


def model(
    count: int, degree: int = 3, extent: float = 1.0, seed: int = 0, active: bool = True, **changes: object
) -> GaussianModel:
    """A model made from a cloud, with random parameters and an optimiser; all SH bands are active, or only band 0."""
    gaussians = GaussianModel(degree, str(changes.get("optimizer_type", "default")))
    gaussians.create_from_pcd(cloud(count, seed), [], extent)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name in ("_features_dc", "_features_rest", "_opacity", "_rotation"):
            getattr(gaussians, name).copy_(torch.randn(getattr(gaussians, name).shape, generator=generator))
        gaussians._scaling += 0.3 * torch.randn(count, 3, generator=generator)
    gaussians.active_sh_degree = degree if active else 0
    gaussians.training_setup(options(**changes))
    return gaussians


def append(gaussians: GaussianModel, count: int, *radii: torch.Tensor) -> None:
    """Append copies of the first Gaussians, which may have radii (count,), as density control does."""
    rows = {group: values[:count] for group, values in parameters(gaussians).items()}
    gaussians.densification_postfix(*(rows.pop(group) for group in STANDARD), *radii, **rows)


def take_steps(gaussians: GaussianModel, steps: int, seed: int = 0) -> None:
    """Do optimiser steps with random gradients, so that every moment has another value."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        for name in GROUPS.values():
            param = getattr(gaussians, name)
            param.grad = torch.randn(param.shape, generator=generator)
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad(set_to_none=True)


def parameters(gaussians: GaussianModel) -> dict[str, torch.Tensor]:
    """Copies of all raw tensors by optimiser group."""
    return {group: getattr(gaussians, name).detach().clone() for group, name in GROUPS.items()}


def moments(gaussians: GaussianModel) -> dict[str, dict[str, torch.Tensor]]:
    """Copies of Adam's state by optimiser group."""
    state = gaussians.optimizer.state
    return {
        group["name"]: {key: value.clone() for key, value in state[group["params"][0]].items()}
        for group in gaussians.optimizer.param_groups
    }
