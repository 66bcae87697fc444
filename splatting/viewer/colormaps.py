"""Colours for depth, opacity, counts and errors."""

import torch
from torch import Tensor

ERROR_GAIN = 5  # as in the contact sheets
_FEW, _MOST = 0.02, 0.98  # quantiles of the depths of a frame that get the darkest and the brightest colour
_SAMPLE = 20_000  # pixels that the quantiles are taken from
# From dark to bright, so that a grey print keeps the order.
_STOPS = ((0.00, 0.00, 0.05), (0.25, 0.05, 0.42), (0.70, 0.18, 0.38), (0.97, 0.50, 0.16), (0.99, 1.00, 0.70))


def colored(values: Tensor) -> Tensor:
    """Colours (3, H, W) of values (H, W) in [0, 1], linear between the stops; others are clamped."""
    stops = torch.tensor(_STOPS, dtype=values.dtype, device=values.device)
    place = values.clamp(0, 1) * (len(_STOPS) - 1)
    below = place.long().clamp_max(len(_STOPS) - 2)
    return torch.lerp(stops[below], stops[below + 1], (place - below)[..., None]).permute(2, 0, 1)


def depth_colors(depth: Tensor, alpha: Tensor) -> Tensor:
    """Colours (3, H, W) of the planes of `view_planes`, (1, H, W) each; depth is inverse: near is bright.

    Where less than half of a pixel is covered there is no depth, and the colour is black.
    """
    there = alpha[0] >= 0.5
    values = depth[0] / alpha[0].clamp_min(1e-6)
    known = values[there]
    if not len(known):
        return torch.zeros_like(alpha).expand(3, -1, -1)
    known = known[:: max(1, len(known) // _SAMPLE)]
    far, near = torch.quantile(known, torch.tensor([_FEW, _MOST], dtype=known.dtype, device=known.device))
    return torch.where(there, colored((values - far) / (near - far).clamp_min(1e-9)), 0.0)


def count_colors(counts: Tensor) -> Tensor:
    """Colours (3, H, W) of counts (H, W): linear, the largest of the image is the brightest."""
    return colored(counts.float() / counts.max().clamp_min(1))


def error_image(photo: Tensor, render: Tensor) -> Tensor:
    """The difference (3, H, W) of two images in [0, 1], times ERROR_GAIN."""
    return ((photo - render).abs() * ERROR_GAIN).clamp(0, 1)
