"""Rules of the strategy budget: split rows in two, fade opacities, and score Gaussians by the error of views.

A score is the share of a Gaussian in the error of training views (Rota Bulo et al. 2024).
"""

import argparse
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from gaussian_renderer import apply_trained_exposure
from gaussian_renderer.blending import weighted_sums
from groundwork.deterministic.portable_math import exp, log
from groundwork.ranks.rows import changes_rows
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.long_axis import long_axis_children
from scene.gaussians.parameters import GaussianParameters


@torch.no_grad()
@changes_rows
def split_in_two(gaussians: GaussianParameters, parents: Tensor) -> None:
    """Split Gaussians along their longest axis (scene/gaussians/long_axis.py).

    One child takes its parent's row, the other is appended. Adam's averages of both begin at zero, which makes the
    first steps long: with the parent's averages, the children would stay almost where they are.

    parents: indices (n,), ascending.
    """
    count = len(parents)
    if not gaussians.shards.ranks.any_rank(count > 0):
        return
    rows = gaussians.rows_at(parents)
    shapes = gaussians.log_scales(), gaussians.opacity_logits()
    log_scales, logits = (values.index_select(0, parents) for values in shapes)
    children = long_axis_children(rows["xyz"], log_scales, rows["rotation"], logits)
    children |= gaussians.raw_shapes(children["opacity"], children["scaling"])
    second = rows | {name: values[count:] for name, values in children.items()}
    gaussians._take(gaussians.cat_tensors_to_optimizer(second))
    gaussians.shards.note_appended(count)
    gaussians.shards.order_appended(gaussians.shards.global_indices(parents))
    gaussians._zero_statistics()
    for name, values in children.items():
        gaussians.raw(name)[parents] = values[:count]
    gaussians.table.restart(parents)


@torch.no_grad()
def fade(gaussians: GaussianParameters, factor: float) -> None:
    """Multiply all opacities by a factor in (0, 1]. Adam's averages stay."""
    if factor < 1.0:
        logits = faded(gaussians.opacity_logits(), factor)
        gaussians.raw("opacity").copy_(gaussians.raw_opacity(logits))


def faded(logits: Tensor, factor: float) -> Tensor:
    """Return the logits (N, 1) of opacities multiplied by a factor in (0, 1): same bits on every device.

    With a = 1 / (1 + e), e = exp(-logit), factor a / (1 - factor a) is factor / (e + 1 - factor).
    """
    below = exp(-logits) + (1.0 - factor)
    return (log(torch.full_like(below, factor)) - log(below)).to(logits.dtype)


def error_map(image: Tensor, target: Tensor, mask: Tensor | None = None, columns: slice | None = None) -> Tensor:
    """Return the mean absolute difference of the channels (1, H, W), 0 where a pixel does not count.

    Each value is divided by the number of pixels that count, as in the mean of the photometric loss.

    image: (3, H, W) float32, not clamped.
    target: (3, H, W), float32 in [0, 1] or uint8.
    mask: (1, H, W) bool, pixels that count; None: all.
    columns: columns that count; None: all.
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
        return _average_channels((image - target).abs()) / image[0].numel()
    image, target = (torch.where(mask, x, 0.0) for x in (image, target))
    return torch.where(mask, _average_channels((image - target).abs()), 0.0) / mask.sum().clamp_min(1)


def _average_channels(errors: Tensor) -> Tensor:
    """Return the mean of three channels (3, H, W), in one order of summation: (1, H, W)."""
    red, green, blue = errors
    return ((red + green + blue) / 3)[None]


def error_scores(
    gaussians: GaussianModel, pipe: argparse.Namespace, exposures: bool, cameras: Sequence[Camera], background: Tensor
) -> Tensor:
    """Return the sum, over pixels and views, of the error times each Gaussian's blending weight: (N,) float64.

    The error is L1 as the loss of training has it: with exposure, mask, columns that count, and no clamp.

    exposures: true if the photos' exposures are trained.
    """

    def errors(image: Tensor, camera: Camera) -> Tensor:
        target, mask = camera.ground_truth(background)
        image = apply_trained_exposure(image, camera, gaussians) if exposures else image
        return error_map(image, target, mask, camera.columns).expand(3, -1, -1).contiguous()

    total = torch.zeros(len(gaussians), dtype=torch.float64, device=background.device)
    for camera in cameras:
        sums = weighted_sums(camera, gaussians, pipe, background, partial(errors, camera=camera))
        total = total + sums[:, 0].to(torch.float64)
    return total
