"""Levels of resolution by the photos' spectrum (the idea of Chen et al. 2025, DashGaussian)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from scene.cameras import Camera
from splatting.training.schedule.pace import Levels

FACTORS = (4.0, 3.0, 2.0, 1.5, 1.0)  # few, because a CUDA graph is recorded for each size
UNTIL = 0.5  # part of the schedule by which views have their full size at the latest
_SAMPLE = 8  # photos that are looked at
_DECIMALS = 3  # of a part, so that the last bits of a Fourier transform decide nothing


def levels_of(cameras: Sequence[Camera]) -> Levels:
    """Levels for the training views: each factor lasts until the schedule has done the part of detail that it keeps.

    The detail of a photo is the sum of the amplitudes of its frequencies, and a photo that is smaller by a factor keeps
    those below 1 / (2 factor) cycles per pixel in both directions. So a quarter of the size trains for longer where
    photos are smooth. The parts are means over some photos, and the schedule is its first half (UNTIL). The rule is
    our own.
    """
    views = [camera for camera in cameras if isinstance(camera, Camera)]
    views = views[:: max(1, len(views) // _SAMPLE)][:_SAMPLE]
    kept = [_detail(camera) for camera in views]
    if not kept:
        return ()
    means = [round(part, _DECIMALS) for part in torch.stack(kept).mean(dim=0).tolist()]
    levels = [(0.0, FACTORS[0])]
    for factor, part in zip(FACTORS[1:], means, strict=False):
        if UNTIL * part > levels[-1][0]:
            levels.append((UNTIL * part, factor))
        else:  # the factor before has no time
            levels[-1] = (levels[-1][0], factor)
    return tuple(levels)


def _detail(camera: Camera) -> Tensor:
    """Part of the detail of a view's photo that each of FACTORS keeps, (5,) float64; all ones if it has none."""
    pixels = camera.target(torch.zeros(3, device=camera.device))
    if camera.columns is not None:
        pixels = pixels[..., camera.columns]
    grey = pixels.cpu().double().mean(dim=0)
    amplitude = torch.fft.rfft2(grey - grey.mean()).abs()
    rows, columns = torch.fft.fftfreq(grey.shape[0]).abs(), torch.fft.rfftfreq(grey.shape[1])
    fineness = torch.maximum(rows[:, None], columns[None, :])
    # The real transform leaves out half of the frequencies, whose amplitudes are the same.
    amplitude = amplitude * torch.where((columns > 0) & (columns < 0.5), 2.0, 1.0)
    total = amplitude.sum()
    if total < 1e-9:
        return torch.ones(len(FACTORS), dtype=torch.float64)
    return torch.stack([amplitude[fineness <= 0.5 / factor].sum() for factor in FACTORS]) / total
