"""Visibility of points in views."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from scene.readers.info import NEAREST
from scene.scene import Scene
from scene.view import View


def is_in_view(points: Tensor, view: Any, enlargement: float = 1.0) -> Tensor:
    """Tell which points (N, 3) a view shows, (N,) bool. enlargement: of the model where it is drawn."""
    lens = getattr(view, "lens", None)
    if lens and lens.chart != "perspective":
        x, y, z, _ = _transform_points(points, view.world_view_transform)
        depth = (x * x + y * y + z * z).sqrt()
        inside = z >= math.cos(min(lens.field(view.image_width, view.image_height), math.pi)) * depth
    else:
        x, y, _, depth = _transform_points(points, view.full_proj_transform)
        inside = (x.abs() < depth) & (y.abs() < depth)
    return inside & (depth > NEAREST / enlargement)


def _transform_points(points: Tensor, matrix: Tensor) -> list[Tensor]:
    """Homogeneous coordinates (N,) behind a transposed matrix (4, 4), each product and sum rounded by itself."""
    x, y, z = points.unbind(1)
    return [x * a + y * b + z * c + d for a, b, c, d in matrix.T.tolist()]


def share_in_view(points: Tensor, cameras: Sequence[View], enlargement: float = 1.0) -> float:
    """The share of points (N, 3) that a camera sees, on the mean of up to 32 cameras. Distortion is left out."""
    views = cameras[:: -(-len(cameras) // 32)]
    return sum(float(is_in_view(points, view, enlargement).float().mean()) for view in views) / len(views)


def share_of(scene: Scene, device: torch.device) -> float:
    """The share of a scene's points that a training view sees; 1 where there are none."""
    cloud = scene.info.point_cloud
    if cloud is None or not len(cloud.points):
        return 1.0
    points = torch.as_tensor(cloud.points, dtype=torch.float32, device=device)
    return share_in_view(points, scene.getTrainCameras(), scene.gaussians.enlargement)
