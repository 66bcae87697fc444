"""Colours of points on surfaces, from the training views that see them.

Views are renders, and not photos: of one exposure, without what moved, and of what was cropped nothing in front.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from applications.export.surfaces import Surfaces
from gaussian_renderer.median_depth import Surface
from scene.cameras import Camera, MiniCam

_AT_ONCE = 1 << 20  # points
_NEAR = 4.0  # voxels between a point and the surface that a view shows there
_SHARPEN = 2  # power by which better views count more
_FLAT = 0.05  # least cosine of the angle between a normal and the view, as normals are not exact


@torch.no_grad()
def average_colors(
    points: np.ndarray, normals: np.ndarray, surfaces: Surfaces, voxel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (P, 3) uint8 of points (P, 3), and which views see (P,) bool.

    The more pixels a view has for the surface, by angle and distance, the more it counts.
    """
    sums = torch.zeros(len(points), 4, device=surfaces.device)
    places, sides = (torch.from_numpy(values).to(surfaces.device) for values in (points, normals))
    for view, surface in surfaces.each("Colouring"):
        layers = torch.cat([surface.color, _remove_edges(surface, _NEAR * voxel)[None]])[None]
        for rows in torch.arange(len(points), device=surfaces.device).split(_AT_ONCE):
            sums[rows] += _weigh_colors(view, layers, places[rows], sides[rows], voxel)
    seen = sums[:, 3] > 0
    colors = sums[:, :3] / torch.where(seen, sums[:, 3], 1)[:, None]
    return (255 * colors.clamp(0, 1)).round().byte().cpu().numpy(), seen.cpu().numpy()


def color_points(points: np.ndarray, normals: np.ndarray, surfaces: Surfaces, voxel: float) -> np.ndarray:
    """Return the colours (P, 3) uint8 of points on a surface; points that no view sees take that of the nearest seen.

    points: (P, 3), and normals (P, 3) of unit length.
    surfaces: depths and colours that the training views show.
    voxel: side of the voxels that the surface was made from, which scales how near a point must be to a seen surface.
    """
    from scipy.spatial import KDTree

    colors, seen = average_colors(points, normals, surfaces, voxel)
    if seen.any() and not seen.all():
        colors[~seen] = colors[seen][KDTree(points[seen]).query(points[~seen])[1]]
    return colors


def _remove_edges(surface: Surface, step: float) -> Tensor:
    """Depths (H, W), 0 also where a pixel beside is nearer or farther by more than `step`: its colour is mixed."""
    depth = surface.depth
    farthest, nearest = (sign * max_pool2d(sign * depth[None], 3, 1, 1)[0] for sign in (1, -1))
    return torch.where(farthest - nearest < step, depth, 0)


def _weigh_colors(view: Camera | MiniCam, layers: Tensor, points: Tensor, normals: Tensor, voxel: float) -> Tensor:
    """(P, 4): colours of points times weights, and weights. layers (1, 4, H, W): colours and depths of the view."""
    clip = points @ view.full_proj_transform[:3] + view.full_proj_transform[3]
    depths = clip[:, 3]
    grid = (clip[:, :2] / depths.clamp_min(voxel)[:, None])[None, None]
    colors = grid_sample(layers[:, :3], grid, align_corners=False)[0, :, 0].T
    found = grid_sample(layers[:, 3:], grid, mode="nearest", align_corners=False)[0, 0, 0]
    away = view.camera_center - points
    distances = away.norm(dim=1)
    cosines = ((away * normals).sum(1) / distances).clamp_min(_FLAT)
    pixels = cosines * (view.image_height * voxel / distances).square()  # of a voxel's size, but for a common factor
    weights = torch.where((found > 0) & ((found - depths).abs() < _NEAR * voxel), pixels.pow(_SHARPEN), 0)
    return torch.cat([colors, torch.ones_like(weights)[:, None]], 1) * weights[:, None]
