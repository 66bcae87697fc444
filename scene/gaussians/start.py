"""Gaussians made from a point cloud, before any training."""

import sys

import numpy as np
import torch
from simple_knn._C import distCUDA2

from scene.gaussians.attributes import Rows, attributes
from scene.gaussians.copies import clusters_of
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import RGB2SH
from utils.system_utils import UserError

# Floor of the squared distance to the neighbours, square units where they are drawn, so that duplicates get a size.
MIN_DISTANCE2 = 1e-7
LONE_POINT_SCALE = 0.01  # initial scale as a part of the extent, for clouds too small to have neighbours
OUTLIER_SCALE = 100.0  # extents: a larger initial scale is that of a stray point; real scenes have up to 20 or so
LARGEST_OUTLIER = 0.1  # extents: scale of a stray point, as large as density control lets a Gaussian be


def start_rows(cloud: BasicPointCloud, extent: float, sh_degree: int, enlargement: float = 1.0) -> Rows:
    """Raw rows of round Gaussians as wide as the distance to their neighbours, of opacity 0.1, coloured as the points.

    extent: of the scene, world units. enlargement: of the model where it is drawn. UserError for a cloud that is empty
    or holds points that are not finite.
    """
    points = np.asarray(cloud.points, dtype=np.float32)
    count = len(points)
    if count == 0:
        raise UserError("the point cloud has no points to start from; give one with --init_pcd_path")
    if not np.isfinite(points).all():
        raise UserError(
            "the point cloud has points that are not finite; remove them, or give another by --init_pcd_path"
        )
    # NumPy's log: one thread, so the same bits for any number of torch's threads.
    log_scale = torch.from_numpy(np.log(_compute_scales(points, extent, enlargement)))
    colors = torch.from_numpy(np.asarray(cloud.colors, dtype=np.float32))
    rows = {name: torch.full((count, *a.shape), a.start) for name, a in attributes(sh_degree).items()}
    return rows | {
        "xyz": torch.from_numpy(points.copy()),
        "f_dc": RGB2SH(colors).reshape(count, 1, 3),
        "scaling": log_scale[:, None].repeat(1, 3),
        "rotation": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
    }


def _compute_scales(points: np.ndarray, extent: float, enlargement: float) -> np.ndarray:
    """Scales (N,) float32, world units: the root mean squared distance to the three nearest neighbours.

    Neighbours are sought in other clusters of points if distances within clusters would say nothing.
    """
    if len(points) < 4:
        return np.full(len(points), LONE_POINT_SCALE * max(extent, 1e-3 / enlargement), dtype=np.float32)
    places = clusters_of(points)
    if places.hides_spacing:
        return _compute_scales(points[places.points], extent, enlargement)[places.of_point]
    scale = np.sqrt(np.maximum(distCUDA2(torch.from_numpy(points)).numpy(), np.float32(MIN_DISTANCE2 / enlargement**2)))
    return _limit_outliers(scale, extent)


def _limit_outliers(scale: np.ndarray, extent: float) -> np.ndarray:
    """Lower the initial scales (N,) of points far from all others, whose Gaussians would cover every image."""
    stray = scale > OUTLIER_SCALE * extent
    if extent <= 0 or not stray.any():
        return scale
    print(
        f"{stray.sum()} of {len(scale)} points are more than {OUTLIER_SCALE:g} times the scene's extent from their "
        f"neighbours; the scale of their Gaussians starts at a tenth of the extent, {LARGEST_OUTLIER * extent:.3g}",
        file=sys.stderr,
    )
    return np.where(stray, np.float32(LARGEST_OUTLIER * extent), scale)
