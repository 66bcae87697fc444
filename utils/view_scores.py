"""Scores of views while training: cheap, on the device, from unrounded renders."""

from collections.abc import Iterable

import torch
from fused_ssim import fused_l1_ssim
from torch import Tensor

from utils.image_utils import as_float


def mean_scores(pairs: Iterable[tuple[Tensor, Tensor]]) -> dict[str, float]:
    """`l1`, `psnr` (dB) and `ssim` of (render, target) pairs, each the mean over the pairs; {} without pairs.

    render: (3, H, W) float32 in [0, 1]; target: the same, or uint8 meaning value / 255. PSNR is from one mean squared
    error over pixels and channels of a pair, infinite where both are equal. metrics.py scores the same views from 8-bit
    PNGs, renders rounded; the training report takes the mean of the three channels' PSNRs. Waits for a GPU once.
    """
    scores = []
    with torch.no_grad():
        for image, target in pairs:
            l1, ssim = fused_l1_ssim(image, target)
            mse = (image - as_float(target)).square().mean()
            scores.append(torch.stack([l1, -10.0 * mse.log10(), ssim]))
        means = torch.stack(scores).double().mean(0).tolist() if scores else []
    return dict(zip(("l1", "psnr", "ssim"), means, strict=False))
