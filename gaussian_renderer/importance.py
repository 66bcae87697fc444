"""Importance of each Gaussian to the training views."""

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import render
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel


def blending_weights(gaussians: GaussianModel, cameras: Sequence[Camera | MiniCam], pipe: argparse.Namespace) -> Tensor:
    """Sum of each Gaussian's blending weights, alpha times transmittance, over all pixels of all views: (N,) float64.

    An image is linear in the Gaussians' colours, and the weight is its derivative, so a backward pass sums them.
    """
    device = gaussians.get_xyz.device
    sums = torch.zeros(len(gaussians), dtype=torch.float64, device=device)
    black = torch.zeros(3, device=device)
    options = {"want_depth": False, "want_visibility": False, "clamp": False}
    for camera in tqdm(cameras, desc="Weighing Gaussians", unit="view", leave=False):
        colors = torch.zeros(len(gaussians), 3, device=device, requires_grad=True)
        image = render(camera, gaussians, pipe, black, override_color=colors, **options)["render"]
        (weights,) = torch.autograd.grad(image[0].sum(), colors)
        sums += weights[:, 0]
    return sums


def most_important(weights: Tensor, count: int) -> Tensor:
    """(N,) bool: the `count` Gaussians of the largest weights, and of equal ones the first."""
    order = torch.argsort(weights, descending=True, stable=True)
    keep = torch.zeros(len(weights), dtype=torch.bool, device=weights.device)
    keep[order[:count]] = True
    return keep
