"""Scores of Gaussians: how much of the error of training views each of them draws (Rota Bulo et al. 2024)."""

import argparse
from collections.abc import Sequence
from functools import partial

import torch
import torch.nn.functional as F
from fused_ssim.maps import gaussian_taps, similarity
from torch import Tensor

from gaussian_renderer import exposed
from gaussian_renderer.blending import weighted_sums
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.loss_utils import C1, C2, SIGMA, WINDOW


def error_map(
    kind: str,
    image: Tensor,
    target: Tensor,
    lambda_dssim: float,
    mask: Tensor | None = None,
    columns: slice | None = None,
) -> Tensor:
    """Errors (1, H, W), at least 0, which are 0 where a pixel does not count.

    kind: l1, the mean of |image - target| over the channels; squared, that of its square; or loss, the error that
    `photometric_loss` has the mean of. image (3, H, W) float32, not clamped; target, mask and columns as there. Each
    error is divided by the number of pixels that count, as in that mean.
    """
    if target.dtype == torch.uint8:
        target = target.float() / 255
    if columns is not None:
        cut = [None if x is None else x[..., columns] for x in (image, target, mask)]
        errors = error_map(kind, *cut[:2], lambda_dssim, cut[2]) * (cut[0].shape[-1] / image.shape[-1])
        whole = torch.zeros_like(image[:1])
        whole[..., columns] = errors
        return whole
    if mask is None:
        return _mean(_errors(kind, image, target, lambda_dssim)) / image[0].numel()
    image, target = (torch.where(mask, x, 0.0) for x in (image, target))
    return torch.where(mask, _mean(_errors(kind, image, target, lambda_dssim)), 0.0) / mask.sum().clamp_min(1)


def _mean(errors: Tensor) -> Tensor:
    """Mean of three channels (3, H, W), in one order of summation: (1, H, W)."""
    red, green, blue = errors
    return ((red + green + blue) / 3)[None]


def _errors(kind: str, image: Tensor, target: Tensor, lambda_dssim: float) -> Tensor:
    difference = image - target
    if kind == "squared":
        return difference * difference
    if kind == "l1":
        return difference.abs()
    dissimilarity = (1.0 - similarity(image, target, _blur, C1, C2)).clamp_min(0.0)
    return (1.0 - lambda_dssim) * difference.abs() + lambda_dssim * dissimilarity


def _blur(image: Tensor) -> Tensor:
    """Blur of SSIM's window, zero beyond the border. Sums of shifted images give the same bits on every device."""
    taps, half = gaussian_taps(WINDOW, SIGMA).tolist(), WINDOW // 2
    for dim, padding in ((-2, (0, 0, half, half)), (-1, (half, half))):
        size, padded, image = image.shape[dim], F.pad(image, padding), torch.zeros_like(image)
        for shift, tap in enumerate(taps):
            image = image + tap * padded.narrow(dim, shift, size)
    return image


def error_scores(
    gaussians: GaussianModel,
    pipe: argparse.Namespace,
    exposures: bool,
    opt: argparse.Namespace,
    cameras: Sequence[Camera],
    background: Tensor,
) -> Tensor:
    """Sum over the pixels of the error times each Gaussian's blending weight, over views: (N,) float64.

    The error is as the loss of training sees it: with exposure, mask, columns that count, and no clamp. exposures:
    whether the photos' exposures are trained. opt: score_error is the kind of error (`error_map`), with lambda_dssim;
    score_join, "sum" or "max", joins the scores of views.
    """

    def errors(image: Tensor, camera: Camera) -> Tensor:
        target, mask = camera.ground_truth(background)
        image = exposed(image, camera, gaussians) if exposures else image
        error = error_map(opt.score_error, image, target, opt.lambda_dssim, mask, camera.columns)
        return error.expand(3, -1, -1).contiguous()

    total = torch.zeros(len(gaussians), dtype=torch.float64, device=background.device)
    for camera in cameras:
        sums = weighted_sums(camera, gaussians, pipe, background, partial(errors, camera=camera))
        score = sums[:, 0].to(torch.float64)
        total = torch.maximum(total, score) if opt.score_join == "max" else total + score
    return total
