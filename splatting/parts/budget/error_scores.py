"""Scores of Gaussians: how much of the error of training views each of them draws (Rota Bulo et al. 2024)."""

import argparse
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from gaussian_renderer import exposed
from gaussian_renderer.blending import weighted_sums
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel


def error_map(image: Tensor, target: Tensor, mask: Tensor | None = None, columns: slice | None = None) -> Tensor:
    """Mean absolute differences of the channels (1, H, W), which are 0 where a pixel does not count.

    image (3, H, W) float32, not clamped; target, mask and columns as for `photometric_loss`. Each is divided by the
    number of pixels that count, as in the mean of that loss.
    """
    if target.dtype == torch.uint8:
        target = target.float() / 255
    if columns is not None:
        cut = [None if x is None else x[..., columns] for x in (image, target, mask)]
        errors = error_map(*cut) * (cut[0].shape[-1] / image.shape[-1])
        whole = torch.zeros_like(image[:1])
        whole[..., columns] = errors
        return whole
    if mask is None:
        return _mean((image - target).abs()) / image[0].numel()
    image, target = (torch.where(mask, x, 0.0) for x in (image, target))
    return torch.where(mask, _mean((image - target).abs()), 0.0) / mask.sum().clamp_min(1)


def _mean(errors: Tensor) -> Tensor:
    """Mean of three channels (3, H, W), in one order of summation: (1, H, W)."""
    red, green, blue = errors
    return ((red + green + blue) / 3)[None]


def error_scores(
    gaussians: GaussianModel, pipe: argparse.Namespace, exposures: bool, cameras: Sequence[Camera], background: Tensor
) -> Tensor:
    """Sum over the pixels of the error times each Gaussian's blending weight, over views: (N,) float64.

    The error is L1 as the loss of training sees it: with exposure, mask, columns that count, and no clamp. exposures:
    whether the photos' exposures are trained.
    """

    def errors(image: Tensor, camera: Camera) -> Tensor:
        target, mask = camera.ground_truth(background)
        image = exposed(image, camera, gaussians) if exposures else image
        return error_map(image, target, mask, camera.columns).expand(3, -1, -1).contiguous()

    total = torch.zeros(len(gaussians), dtype=torch.float64, device=background.device)
    for camera in cameras:
        sums = weighted_sums(camera, gaussians, pipe, background, partial(errors, camera=camera))
        total = total + sums[:, 0].to(torch.float64)
    return total
