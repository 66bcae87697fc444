"""`distCUDA2`, the checked Python form of the operator simple_knn::mean_distance2."""

import torch
from torch import library

from simple_knn.backend import OPERATORS, has_kernels


@library.register_fake("simple_knn::mean_distance2")
def _fake(points: torch.Tensor) -> torch.Tensor:
    return points.new_empty(points.shape[0])


def distCUDA2(points: torch.Tensor) -> torch.Tensor:
    """Mean squared distance of each point to its three nearest other points, exact.

    points: (N, 3) float32 or float64, in any unit. Returns (N,) in that unit squared, with the dtype and device of
    points and no gradient. Other points are those of another index: a duplicate is a neighbour at distance 0. If there
    are fewer than three others, the mean is over those; a single point gets 0. A point with a NaN or an infinite
    coordinate gets 0 and is no neighbour of any other. A result beyond the dtype's range is its largest finite number.
    Raises TypeError for another dtype, ValueError for another shape and for a device that this build does not support.
    """
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"points must be float32 or float64, got {points.dtype}: convert with points.float()")
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"points must be (N, 3), got {tuple(points.shape)}")
    device = points.device.type
    if not has_kernels("mean_distance2", device):
        raise ValueError(f"this build of simple_knn has no {device} backend: pass points.cpu()")
    return OPERATORS.mean_distance2(points.detach())
