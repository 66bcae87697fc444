"""A sky behind all points (--sky): Gaussians on a far sphere, where photos show directions without any point.

They begin with the colours that the photos have there. The sphere is so far away that photos hardly see it move, and
that no step brings a mean back among the points. The loss asks for no inverse depth there, so nothing stays before it.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.density_rules import logit
from scene.gaussians.start import start_rows
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.tracks import projected
from scene.scene import Scene
from splatting.training.sparse_depth import PointDepths
from utils.graphics_utils import BasicPointCloud
from utils.image_utils import as_float
from utils.system_utils import UserError

FEWEST = 0.03  # of the directions that several photos show; with fewer there is no sky
ALIKE = 0.1  # standard deviation of a direction's colours over the photos, at most, on the mean of the channels
_EXTENTS, _TIMES = 100.0, 4.0  # the sphere's radius: in extents, and in distances of nearly all points, at least
_NEARLY_ALL = 0.99
_WIDEST = 1 / 16  # of the radius: the largest scale, of which eight are half a radius
_AROUND = 1, 4  # cells around a point that are not the sky's, and that do not tell of one
_ACROSS = 64  # Gaussians of the sky, and cells, across a photo
_MOST = 200_000  # all around
_WEIGHT = 0.1  # of the inverse depth, in 1 / extents, of the sky's pixels in the loss
_OPACITY = 0.9  # at first: what lets the background through asks for Gaussians in front of it


class Sky:
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
        x, y, inside = projected(view, self.points)
        width, height = camera.image_width, camera.image_height
        places = _at(np.empty((height, width), dtype=bool), x[inside] / view.width, y[inside] / view.height)
        pixels = np.unique(places[0] * width + places[1])
        if not len(pixels):
            return None
        values = torch.tensor([1 / self.radius, _WEIGHT * extent * width / (height * _ACROSS**2)]).to(camera.device)
        inverse, weights = values[:, None].expand(2, len(pixels)).contiguous()
        return PointDepths(torch.from_numpy(pixels).to(camera.device), inverse, weights)

    @classmethod
    def around(cls, info: SceneInfo) -> "Sky":
        """The sphere around a scene's cameras and points."""
        center = -info.nerf_normalization["translate"]
        distances = np.linalg.norm(info.point_cloud.points - center, axis=1)
        radius = max(_EXTENTS * info.extent, _TIMES * float(np.quantile(distances, _NEARLY_ALL)))
        return cls(center.tolist(), radius)

    @classmethod
    def restored(cls, state: Any) -> "Sky":
        """The sphere of `captured()`, without points. UserError for anything else."""
        try:
            center, radius = [float(value) for value in state["center"]], float(state["radius"])
            if len(center) != 3 or not all(map(math.isfinite, center)) or not 0 < radius < math.inf:
                raise ValueError("a number is missing or not finite")
        except (TypeError, ValueError, KeyError) as error:
            raise UserError(f"the sky has no center and radius ({error}); give the files of its training") from error
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


def with_sky(scene: Scene, gaussians: GaussianModel) -> Sky | None:
    """Add a sky to a model that is to be trained, and say so; None, where points lie in nearly all directions."""
    sky = Sky.around(scene.info)
    cloud, share = find_sky(scene, sky)
    text = f"--sky auto: {share:.1%} of the directions that several photos show have one colour and no points"
    if share < FEWEST:
        print(f"{text}, so there is no sky")
        return None
    print(f"{text}; {len(cloud.points):,} Gaussians of a sky begin there, {sky.radius:.3g} units away")
    new = start_rows(cloud, scene.cameras_extent, gaussians.max_sh_degree)
    new["opacity"] = gaussians.raw_opacity(torch.full_like(new["opacity"], logit(_OPACITY)))
    gaussians.set_rows({name: torch.cat((own, new[name].to(own))) for name, own in gaussians.rows().items()})
    sky.points = cloud.points
    return sky


def resumed_sky(state: Any, scene: Scene) -> Sky:
    """The sky of a checkpoint, from `captured()`."""
    sky = Sky.restored(state)
    sky.points = find_sky(scene, sky)[0].points
    return sky


def find_sky(scene: Scene, sky: Sky) -> tuple[BasicPointCloud, float]:
    """Points of the sky, and their share of the directions that two or more training photos show.

    A direction is the sky's if no photo that shows it has a point near by, and all have the same colour there.
    """
    info = scene.info
    shell = sky.center + sky.radius * _directions(info.train_cameras)
    shown, taken = np.zeros(len(shell)), np.zeros((len(_AROUND), len(shell)))
    color, square = np.zeros((2, len(shell), 3))
    for camera in sorted(scene.getTrainCameras(), key=lambda camera: camera.uid):
        view = info.train_cameras[camera.uid]
        photo, counts = _small(camera)
        x, y, inside = projected(view, shell)
        which = np.flatnonzero(inside)
        places = x[which] / view.width, y[which] / view.height
        keep = counts[_at(counts, *places)]
        which, *places = (values[keep] for values in (which, *places))
        near, seen = _near_points(view, info.point_cloud.points), photo[_at(counts, *places)]
        taken[:, which] += near[(slice(None), *_at(near[0], *places))]
        shown[which] += 1
        color[which] += seen
        square[which] += seen**2
    color, square = (values / np.maximum(shown, 1)[:, None] for values in (color, square))
    alike = np.sqrt(np.maximum(square - color**2, 0)).mean(1) < ALIKE
    free, several = (shown > 0) & (taken[0] == 0) & alike, shown > 1
    colors = color[free].astype(np.float32)
    share = float((free & (taken[1] == 0))[several].mean()) if several.any() else 0.0
    return BasicPointCloud(shell[free], colors, np.zeros_like(colors)), share


def _directions(views: list[CameraInfo]) -> np.ndarray:
    """Unit vectors (N, 3) all around, _ACROSS over the width of a photo: a Fibonacci lattice (Gonzalez 2010)."""
    apart = float(np.median([view.width / view.fx for view in views])) / _ACROSS
    count = min(int(4 * math.pi / (0.75**0.5 * apart**2)), _MOST)
    place = np.arange(count) + 0.5
    height, turn = 1 - 2 * place / count, math.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], axis=1)


def _small(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A photo (h, w, 3), _ACROSS wide, in [0, 1], and where all its pixels count and are opaque, (h, w) bool."""
    black = torch.zeros(3, device=camera.device)
    image, counted = camera.ground_truth(black)
    counts = (image == camera.target(black + 1)).all(0, keepdim=True)
    counts = counts if counted is None else counts & counted
    if camera.columns is not None:
        counts = counts.clone()
        outside = torch.ones_like(counts[0, 0])
        outside[camera.columns] = False
        counts[..., outside] = False
    size = [max(side * _ACROSS // camera.image_width, 1) for side in image.shape[1:]]
    photo, counts = (adaptive_avg_pool2d(values, size) for values in (as_float(image), counts.float()))
    return photo.permute(1, 2, 0).cpu().numpy(), (counts[0] == 1).cpu().numpy()


def _near_points(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    """Cells of a photo that have a point in them, or so few cells away as _AROUND says, (2, h, w) bool."""
    cells = np.zeros((max(view.height * _ACROSS // view.width, 1), _ACROSS), dtype=bool)
    x, y, inside = projected(view, points.astype(np.float64))
    cells[_at(cells, x[inside] / view.width, y[inside] / view.height)] = True
    taken = torch.from_numpy(cells)[None].float()
    return torch.cat([max_pool2d(taken, 2 * n + 1, stride=1, padding=n) for n in _AROUND]).numpy() > 0


def _at(table: np.ndarray, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a table at parts of a photo's width and height, in [0, 1)."""
    height, width = table.shape
    return np.minimum(down * height, height - 1).astype(int), np.minimum(across * width, width - 1).astype(int)
