"""Scores of views while training: cheap, on the device, from unrounded renders."""

from collections.abc import Iterable

import torch
from torch import Tensor

from utils.image_utils import as_float, pixels_that_count
from utils.loss_utils import l1_and_ssim


def mean_scores(pairs: Iterable[tuple[Tensor, Tensor, Tensor | None]]) -> dict[str, float]:
    """`l1`, `psnr` (dB) and `ssim` of (render, target, mask), each the mean over these; {} without any.

    mask: (1, H, W) bool, the pixels that count, or None (utils/loss_utils.py); without one that counts it is left out.
    render: (3, H, W) float32 in [0, 1]; target: the same, or uint8 meaning value / 255. PSNR is from one mean squared
    error over pixels and channels of a pair, infinite where both are equal. metrics.py scores the same views from 8-bit
    PNGs, renders rounded; the training report takes the mean of the three channels' PSNRs. Without masks it waits for a
    GPU once.
    """
    scores = []
    with torch.no_grad():
        for image, target, mask in pairs:
            if mask is not None and not mask.any():
                continue
            l1, ssim = l1_and_ssim(image, target, mask)
            mse = pixels_that_count(image - as_float(target), mask).square().mean()
            scores.append(torch.stack([l1, -10.0 * mse.log10(), ssim]))
        means = torch.stack(scores).double().mean(0).tolist() if scores else []
    return dict(zip(("l1", "psnr", "ssim"), means, strict=False))
