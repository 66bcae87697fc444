"""A sky behind all points (--sky): Gaussians on a far sphere, where photos show directions without any point.

They begin with the colours that the photos have there. The sphere is so far away that photos hardly see it move, and
that no step brings a mean back among the points. The loss asks for no inverse depth there, so nothing stays before it.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.density_rules import logit
from scene.gaussians.start import start_rows
from scene.point_depths import PointDepths
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.tracks import projected
from scene.scene import Scene
from splatting.parts.sky.directions import ACROSS, FEWEST, cell_at, find_directions
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

_EXTENTS, _TIMES = 100.0, 4.0  # the sphere's radius: in extents, and in distances of nearly all points, at least
_NEARLY_ALL = 0.99
_WIDEST = 1 / 16  # of the radius: the largest scale, of which eight are half a radius
_WEIGHT = 0.1  # of the inverse depth, in 1 / extents, of the sky's pixels in the loss
_OPACITY = 0.9  # at first: what lets the background through asks for Gaussians in front of it


class Shell:
    """The sphere of the sky's Gaussians. center (3,), radius: world units.

    points (N, 3): where they began; None: not known.
    """

    def __init__(self, center: list[float], radius: float) -> None:
        self.center, self.radius = center, radius
        self.points: np.ndarray | None = None
        self._known: dict[tuple[int, int, int], PointDepths | None] = {}

    def at(self, camera: Camera, scene: Scene) -> PointDepths | None:
        """Pixels of a view that are far away, as each stands for those around it; None if there are none."""
        key = camera.uid, camera.image_width, camera.image_height
        if key not in self._known:
            self._known[key] = self._depths(camera, scene.info.train_cameras[camera.uid], scene.cameras_extent)
        return self._known[key]

    def _depths(self, camera: Camera, view: CameraInfo, extent: float) -> PointDepths | None:
        if not len(self.points):
            return None
        x, y, inside = projected(view, self.points)
        width, height = camera.image_width, camera.image_height
        places = cell_at(np.empty((height, width), dtype=bool), x[inside] / view.width, y[inside] / view.height)
        pixels = np.unique(places[0] * width + places[1])
        if not len(pixels):
            return None
        values = torch.tensor([1 / self.radius, _WEIGHT * extent * width / (height * ACROSS**2)]).to(camera.device)
        inverse, weights = values[:, None].expand(2, len(pixels)).contiguous()
        return PointDepths(torch.from_numpy(pixels).to(camera.device), inverse, weights)

    @classmethod
    def around(cls, info: SceneInfo) -> "Shell":
        """The sphere around a scene's cameras and points."""
        center = -info.nerf_normalization["translate"]
        distances = np.linalg.norm(info.point_cloud.points - center, axis=1)
        radius = max(_EXTENTS * info.extent, _TIMES * float(np.quantile(distances, _NEARLY_ALL)))
        return cls(center.tolist(), radius)

    @classmethod
    def restored(cls, state: Any) -> "Shell":
        """The sphere of `captured()`, without points. UserError for anything else."""
        try:
            center, radius = [float(value) for value in state["center"]], float(state["radius"])
            if len(center) != 3 or not all(map(math.isfinite, center)) or not 0 < radius < math.inf:
                raise ValueError("a number is missing or not finite")
        except (TypeError, ValueError, KeyError) as error:
            raise UserError(
                f"the saved sky lacks a valid centre and radius ({error}); restore the files of its training"
            ) from error
        return cls(center, radius)

    def captured(self) -> dict[str, Any]:
        """The sphere as plain values."""
        return {"center": self.center, "radius": self.radius}

    def rows(self, means: Tensor) -> Tensor:
        """Which of the means (N, 3) are the sky's, (N,) bool: those beyond half of its radius."""
        return self._distances2(means) > (0.5 * self.radius) ** 2

    def _distances2(self, means: Tensor) -> Tensor:
        x, y, z = (means - means.new_tensor(self.center)).unbind(1)
        return x * x + y * y + z * z

    @torch.no_grad()
    def hold(self, gaussians: GaussianModel) -> None:
        """Put the sky's Gaussians back on the sphere, and make those smaller that a split could send away from it."""
        means, scales = gaussians.raw("xyz"), gaussians.raw("scaling")
        far, center = self.rows(means)[:, None], means.new_tensor(self.center)
        factor = self.radius / self._distances2(means).sqrt()
        means.copy_(torch.where(far, center + (means - center) * factor[:, None], means))
        largest = math.log(_WIDEST * self.radius)
        scales.copy_(torch.where(far, gaussians.raw_scaling(gaussians.log_scales().clamp_max(largest)), scales))


def with_shell(scene: Scene, gaussians: GaussianModel) -> Shell | None:
    """Add a sky to a model that is to be trained, and say so; None, where points lie in nearly all directions."""
    sky = Shell.around(scene.info)
    cloud, share = find_sky(scene, sky)
    text = f"--sky auto: {said_of_sky(share)}"
    if share < FEWEST:
        print(f"{text}, so there is no sky")
        return None
    print(f"{text}; {len(cloud.points):,} Gaussians of a sky are added there, {sky.radius:.3g} units away")
    new = start_rows(cloud, scene.cameras_extent, gaussians.max_sh_degree, gaussians.enlargement)
    new["opacity"] = gaussians.raw_opacity(torch.full_like(new["opacity"], logit(_OPACITY)))
    gaussians.set_rows({name: torch.cat((own, new[name].to(own))) for name, own in gaussians.rows().items()})
    sky.points = cloud.points
    return sky


def resumed_shell(state: Any, scene: Scene) -> Shell:
    """The sky of a checkpoint, from `captured()`."""
    sky = Shell.restored(state)
    sky.points = find_sky(scene, sky)[0].points
    return sky


def said_of_sky(share: float) -> str:
    """What a share of `find_sky` says."""
    return f"{share:.1%} of the directions that several photos show look like a far sky: one colour and no points"


def find_sky(scene: Scene, sky: Shell) -> tuple[BasicPointCloud, float]:
    """Points of a sky, and their share of the directions that photos show, as `find_directions`."""
    return find_directions(scene, sky.center, sky.radius)
