"""At which rate a view samples points."""

import math
from typing import Any

import torch
from torch import Tensor

NEAREST = 0.2  # depth, below which no Gaussian is drawn


def sampling_rate(points: Tensor, view: Any) -> Tensor:
    """Pixels of a view by unit of length at points (N, 3); (N,), 0 at points that it does not show.

    A lens counts by its focal length on the axis; in a fisheye or a panorama, pixels are proportional to angles.
    """
    lens = getattr(view, "lens", None)
    if lens and lens.chart != "perspective":
        x, y, z, _ = _transformed(points, view.world_view_transform)
        depth = (x * x + y * y + z * z).sqrt()
        field = min(lens.field(view.image_width, view.image_height), math.pi)
        seen, focal = z >= math.cos(field) * depth, max(lens.focal)
    else:
        x, y, _, depth = _transformed(points, view.full_proj_transform)
        seen = (x.abs() < depth) & (y.abs() < depth)
        sides = (view.image_width, view.FoVx), (view.image_height, view.FoVy)
        focal = max(side / (2 * math.tan(angle / 2)) for side, angle in sides)
    return torch.where(seen & (depth > NEAREST), focal / depth, 0.0)


def _transformed(points: Tensor, matrix: Tensor) -> list[Tensor]:
    """Homogeneous coordinates (N,) behind a transposed matrix (4, 4), each product and sum rounded by itself."""
    x, y, z = points.unbind(1)
    return [x * a + y * b + z * c + d for a, b, c, d in matrix.T.tolist()]
