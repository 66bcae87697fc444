"""Inverse depth at pixels of a view, from points: as supervision (Deng et al. 2022, DS-NeRF, section 3), and as scores.

Points of structure from motion that are never trained on score the depth of test views.
"""

import numpy as np
import torch
from torch import Tensor

from scene.readers.info import CameraInfo
from scene.readers.tracks import PhotoPoints, read_tracks
from scene.scene import Scene
from scene.view import View

HELD_OUT = 8  # every so many points, by the rank of their ids, are never trained on, and score
_NEAR = 0.01  # depth where it is drawn, as the camera's


class PointDepths:
    """Points of a view: pixels (K,) int64, of which none is there twice, inverse depths and weights (K,) float32.

    Weights have the unit of depth, so that the loss has none. Of points, their sum is 1 / the mean inverse depth.
    """

    def __init__(self, pixels: Tensor, inverse_depths: Tensor, weights: Tensor) -> None:
        self.pixels, self.inverse_depths, self.weights = pixels, inverse_depths, weights

    def loss(self, inverse_depth: Tensor, mask: Tensor | None = None) -> Tensor:
        """Weighted sum of |difference| to a rendered inverse depth (1, H, W). mask: (1, H, W) bool, what counts.

        Pixels are read once each, so that its gradient has one order of sums.
        """
        weights = self.weights if mask is None else self.weights * mask.flatten()[self.pixels]
        return (weights * (inverse_depth.flatten()[self.pixels] - self.inverse_depths).abs()).sum()

    def scores(self, inverse_depth: Tensor, mask: Tensor | None = None) -> dict[str, float]:
        """`depth` and `depth_95`: the median of the relative errors, and what 95 % are below; {} if no point counts.

        Arguments as for `loss`.
        """
        errors = (inverse_depth.flatten()[self.pixels] / self.inverse_depths - 1).abs()
        errors = (errors if mask is None else errors[mask.flatten()[self.pixels]]).cpu().numpy()
        if not len(errors):
            return {}
        return dict(zip(("depth", "depth_95"), np.quantile(errors, (0.5, 0.95)).tolist(), strict=True))


def held_out_points(scene: Scene, source_path: str) -> dict[str, PointDepths]:
    """The points that score the depth of test views, by image name; of views that have some."""
    views, cameras = scene.info.test_cameras, {camera.image_name: camera for camera in scene.getTestCameras()}
    tracks = zip(views, read_tracks(source_path, views, scene.info.offset), strict=True)
    options = {"held_out": True, "enlargement": scene.gaussians.enlargement}
    found = {v.image_name: t and points_of(cameras[v.image_name], v, t, **options) for v, t in tracks}
    return {name: points for name, points in found.items() if points is not None}


def points_of(
    camera: View,
    view: CameraInfo,
    photo: PhotoPoints,
    weight: float = 1.0,
    held_out: bool = False,
    enlargement: float = 1.0,
) -> PointDepths | None:
    """Make the depths of a photo's points in a view, with weights of sum `weight`; one point a pixel, the heaviest.

    view: has the dataset's pose and lens, so that a resumed training, where they may have moved, has the same points.
    held_out: those that are never trained on, in place of the others. enlargement: of the model where it is drawn.
    """
    local = photo.points @ view.R + view.T
    if camera.lens is None:
        scale = camera.image_width / view.width, camera.image_height / view.height
        places = (photo.rays * (view.fx, view.fy) + (view.cx, view.cy)) * scale
    else:
        places = photo.places * (camera.image_width, camera.image_height)
    by_distance = camera.lens is not None and camera.lens.chart != "perspective"
    depths = np.linalg.norm(local, axis=1) if by_distance else local[:, 2]
    columns = range(camera.image_width)[camera.columns or slice(None)]
    x, y = np.floor(places).T
    trust = (photo.lengths - 1) / (1 + photo.errors**2)
    counts = (depths > _NEAR / enlargement) & (trust > 0) & ((photo.ranks % HELD_OUT == 0) == held_out)
    counts &= (x >= columns.start) & (x < columns.stop) & (y >= 0) & (y < camera.image_height)
    if not counts.any():
        return None
    order = np.flatnonzero(counts)[np.argsort(-trust[counts], kind="stable")]
    pixels, first = np.unique((y * camera.image_width + x)[order].astype(np.int64), return_index=True)
    inverse, trust = 1 / depths[order][first], trust[order][first]
    trust *= weight / (trust * inverse).sum()
    device = camera.device
    floats = (torch.from_numpy(values).to(device, torch.float32) for values in (inverse, trust))
    return PointDepths(torch.from_numpy(pixels).to(device), *floats)
