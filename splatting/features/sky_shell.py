"""The sphere of a sky behind all points (--sky), with Gaussians in the directions where photos show no point.

The Gaussians begin with the colours that the photos have there. The sphere is so far away that photos hardly see it
move, and that no step brings a mean back among the points. The loss pulls the inverse depth in these directions to that
of the sphere, so nothing stays before it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from groundwork.deterministic.portable_math import square_root
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.density_rules import logit
from scene.gaussians.start import start_rows
from scene.point_depths import PointDepths
from scene.readers.info import CameraInfo, SceneInfo, up_of
from scene.readers.tracks import projected
from scene.scene import Scene
from utils.graphics_utils import BasicPointCloud
from utils.image_utils import as_float
from utils.system_utils import UserError

_EXTENTS, _TIMES = 100.0, 4.0  # the sphere's radius: in extents, and in distances of nearly all points, at least
_NEARLY_ALL = 0.99
_WIDEST = 1 / 16  # of the radius: the largest scale, of which eight are half a radius
_WEIGHT = 0.1  # of the inverse depth, in 1 / extents, of the sky's pixels in the loss
_OPACITY = 0.9  # at first: what lets the background through asks for Gaussians in front of it


class Shell:
    """The sphere of the sky's Gaussians, in world units.

    center: (3,).
    radius: radius of the sphere.
    points: (N, 3), the places where the Gaussians began; None: not known.
    """

    def __init__(self, center: list[float], radius: float) -> None:
        self.center, self.radius = center, radius
        self.points: np.ndarray | None = None
        self._known: dict[tuple[int, int, int], PointDepths | None] = {}

    def at(self, camera: Camera, scene: Scene) -> PointDepths | None:
        """Return the depths of the sky's pixels in a view, each for the pixels around it; None if there are none."""
        key = camera.uid, camera.image_width, camera.image_height
        if key not in self._known:
            self._known[key] = self._find_depths(camera, scene.info.train_cameras[camera.uid], scene.cameras_extent)
        return self._known[key]

    def _find_depths(self, camera: Camera, view: CameraInfo, extent: float) -> PointDepths | None:
        """Return inverse depths and weights of the pixels of a view that show a point of the sky; None without any.

        view: record that the camera was made from.
        extent: extent of the scene, in world units.
        """
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
        """Return a sphere around a scene's cameras and points."""
        center = -info.nerf_normalization["translate"]
        distances = np.linalg.norm(info.point_cloud.points - center, axis=1)
        radius = max(_EXTENTS * info.extent, _TIMES * float(np.quantile(distances, _NEARLY_ALL)))
        return cls(center.tolist(), radius)

    @classmethod
    def restored(cls, state: Any) -> "Shell":
        """Return the sphere of `captured()`, without points. UserError for anything else."""
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
        """Return the sphere as plain values."""
        return {"center": self.center, "radius": self.radius}

    def rows(self, means: Tensor) -> Tensor:
        """Return a mask of the means that are the sky's, (N,) bool: those beyond half of its radius.

        means: (N, 3).
        """
        return self._squared_distances(means) > (0.5 * self.radius) ** 2

    def _squared_distances(self, means: Tensor) -> Tensor:
        x, y, z = (means - means.new_tensor(self.center)).unbind(1)
        return x * x + y * y + z * z

    @torch.no_grad()
    def hold(self, gaussians: GaussianModel) -> None:
        """Put the sky's Gaussians back on the sphere, and shrink those that a split could send away from it."""
        means, scales = gaussians.raw("xyz"), gaussians.raw("scaling")
        far, center = self.rows(means)[:, None], means.new_tensor(self.center)
        factor = self.radius / square_root(self._squared_distances(means))
        means.copy_(torch.where(far, center + (means - center) * factor[:, None], means))
        largest = math.log(_WIDEST * self.radius)
        scales.copy_(torch.where(far, gaussians.raw_scaling(gaussians.log_scales().clamp_max(largest)), scales))


def with_shell(scene: Scene, gaussians: GaussianModel) -> Shell | None:
    """Add a sky to a model that is to be trained, and print so; None where points lie in nearly all directions."""
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
    """Return the sky of a checkpoint, from `captured()`."""
    sky = Shell.restored(state)
    sky.points = find_sky(scene, sky)[0].points
    return sky


def said_of_sky(share: float) -> str:
    """Return a sentence about a share that `find_sky` has found."""
    return f"{share:.1%} of the directions that several photos show look like a far sky: one colour and no points"


def find_sky(scene: Scene, sky: Shell) -> tuple[BasicPointCloud, float]:
    """Return points of a sky, and their share of the directions that photos show, as `find_directions` does."""
    return find_directions(scene, sky.center, sky.radius)


FEWEST = 0.03  # of the directions that several photos show; with fewer there is no sky
FEWEST_POINTS = 2000  # with fewer, a place without points says nothing
ALIKE = 0.1  # standard deviation of a direction's colours over the photos, at most, on the mean of the channels
ACROSS = 64  # Gaussians of the sky, and cells, across a photo
_SMOOTH = 0.04  # standard deviation of a photo over three by three cells, at most, on the mean of the channels
_AROUND = 1, 4  # cells around a point that are not the sky's, and that do not tell of one, at least
_SPACINGS = 1.0, 2.0  # the same in mean distances of a photo's points: by chance 0.01 % of places have none in two
_BELOW = -0.2  # sine of the elevation: a sky ends below the horizon where the ground ends
_NEARER = 1.0, 1.5, 2.2, 3.3, 5.0, 7.5  # extents: distances of walls
_BETTER = 0.5  # mean square of the colours' differences there, as a part of that far away, at most: it is a wall
_NOISE = 1e-4  # of that mean square: of the photos
_MOST = 200_000  # directions all around


class _Photo(NamedTuple):
    """A photo in cells (h, w).

    colors: (h, w, 3).
    counts: cells that count, (h, w) bool.
    near: cells near points, (2, h, w) bool, by a smaller and a larger distance (`_find_near_points`).
    smooth: cells that are smooth, (h, w) bool.
    """

    view: CameraInfo
    colors: np.ndarray
    counts: np.ndarray
    near: np.ndarray
    smooth: np.ndarray


class _Seen(NamedTuple):
    """The sight of all photos at places (N,).

    photos: number of photos that show the place, (N,).
    taken: number of these with a point near by, (2, N), by a smaller and a larger distance (`_find_near_points`).
    smooth: number of these that are smooth there, (N,).
    colors: mean colour, (N, 3).
    squares: mean squared difference of the colours from their mean, on the mean of the channels, (N,).
    """

    photos: np.ndarray
    taken: np.ndarray
    smooth: np.ndarray
    colors: np.ndarray
    squares: np.ndarray


def find_directions(scene: Scene, center: list[float], radius: float) -> tuple[BasicPointCloud, float]:
    """Return points of a sky on a sphere, and their share of the directions that two or more training photos show.

    A direction is the sky's if no photo that shows it has a point near by, and all have the same colour there. The
    share counts only smooth directions above the horizon. It is 0 with fewer than FEWEST_POINTS points, and where the
    photos agree better on a surface nearer by.
    """
    info = scene.info
    photos = [_read_cells(camera, info.train_cameras[camera.uid], info.point_cloud.points)
              for camera in sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)]  # fmt: skip
    toward = _spread_directions(info.train_cameras)
    shell, height = center + radius * toward, toward @ up_of(np.stack([view.R for view in info.train_cameras]))
    seen = _collect_sights(photos, shell)
    alike, several = np.sqrt(seen.squares) < ALIKE, seen.photos > 1
    free = (seen.photos > 0) & (seen.taken[0] == 0) & alike & (height > _BELOW)
    colors = seen.colors[free].astype(np.float32)
    cloud = BasicPointCloud(shell[free], colors, np.zeros_like(colors))
    clear = free & (seen.taken[1] == 0) & (2 * seen.smooth > seen.photos) & (height > 0)
    share = float(clear[several].mean()) if several.any() else 0.0
    bare = several & (seen.taken[0] == 0) & (height > 0)
    near = share >= FEWEST and _is_near(photos, center, toward[bare], radius, info.extent)
    return cloud, 0.0 if near or len(info.point_cloud.points) < FEWEST_POINTS else share


def _is_near(photos: list[_Photo], center: list[float], toward: np.ndarray, radius: float, extent: float) -> bool:
    """Tell whether photos agree better on directions without points if these show something near."""
    far = _collect_sights(photos, center + radius * toward, without_points=True)
    for times in _NEARER:
        near = _collect_sights(photos, center + times * extent * toward, without_points=True)
        both = (far.photos > 1) & (near.photos > 1)
        if both.any() and near.squares[both].mean() + _NOISE < _BETTER * (far.squares[both].mean() + _NOISE):
            return True
    return False


def _collect_sights(photos: list[_Photo], places: np.ndarray, without_points: bool = False) -> _Seen:
    """Collect the colours and points of the photos at places (N, 3).

    without_points: true to leave out places near points of a photo.
    """
    shown, smooth = np.zeros((2, len(places)))
    taken, color, square = np.zeros((len(_AROUND), len(places))), *np.zeros((2, len(places), 3))
    for photo in photos:
        x, y, inside = projected(photo.view, places)
        which = np.flatnonzero(inside)
        spot = x[which] / photo.view.width, y[which] / photo.view.height
        good = photo.counts & ~photo.near[0] if without_points else photo.counts
        keep = good[cell_at(good, *spot)]
        which, *spot = (values[keep] for values in (which, *spot))
        cell = cell_at(photo.counts, *spot)
        taken[:, which] += photo.near[(slice(None), *cell)]
        smooth[which] += photo.smooth[cell]
        shown[which] += 1
        color[which] += photo.colors[cell]
        square[which] += photo.colors[cell] ** 2
    color, square = (values / np.maximum(shown, 1)[:, None] for values in (color, square))
    return _Seen(shown, taken, smooth, color, np.maximum(square - color**2, 0).mean(1))


def _spread_directions(views: list[CameraInfo]) -> np.ndarray:
    """Return unit vectors (N, 3) all around, ACROSS over the width of a photo: a Fibonacci lattice (Gonzalez 2010)."""
    apart = float(np.median([view.width / view.fx for view in views])) / ACROSS
    count = min(int(4 * math.pi / (0.75**0.5 * apart**2)), _MOST)
    place = np.arange(count) + 0.5
    height, turn = 1 - 2 * place / count, math.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], axis=1)


def _read_cells(camera: Camera, view: CameraInfo, points: np.ndarray) -> _Photo:
    """Return a photo in cells, ACROSS over its width; a cell counts if all its pixels count and are opaque."""
    black = torch.zeros(3, device=camera.device)
    image, counted = camera.ground_truth(black)
    counts = (image == camera.target(black + 1)).all(0, keepdim=True)
    counts = counts if counted is None else counts & counted
    if camera.columns is not None:
        counts = counts.clone()
        outside = torch.ones_like(counts[0, 0])
        outside[camera.columns] = False
        counts[..., outside] = False
    size = [max(side * ACROSS // camera.image_width, 1) for side in image.shape[1:]]
    cells, counts = (adaptive_avg_pool2d(values, size) for values in (as_float(image), counts.float()))
    mean, square = (avg_pool2d(values[None], 3, 1, 1, count_include_pad=False)[0] for values in (cells, cells**2))
    smooth = (square - mean**2).mean(0) < _SMOOTH**2
    counts, smooth = (values.cpu().numpy() for values in (counts[0] == 1, smooth))
    return _Photo(view, cells.permute(1, 2, 0).cpu().numpy(), counts, _find_near_points(view, points), smooth)


def _find_near_points(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    """Return the cells of a photo that have a point near by: (2, h, w) bool, a layer for each of two distances.

    Layer 0, by the smaller distance: cells that do not show the sky. Layer 1, by the larger one: cells that are no
    evidence of a sky, and do not count in its share. Each distance is a number of cells (_AROUND) or, if that is more,
    of mean distances of the photo's points (_SPACINGS). All is true for a photo that shows no point: it proves no sky.

    points: (P, 3), in the world.
    """
    cells = np.zeros((max(view.height * ACROSS // view.width, 1), ACROSS), dtype=bool)
    x, y, inside = projected(view, points.astype(np.float64))
    if not inside.any():
        return np.ones((2, *cells.shape), dtype=bool)
    cells[cell_at(cells, x[inside] / view.width, y[inside] / view.height)] = True
    taken, spacing = torch.from_numpy(cells)[None].float(), math.sqrt(cells.size / inside.sum())
    reach = [max(least, round(times * spacing)) for least, times in zip(_AROUND, _SPACINGS, strict=True)]
    return torch.cat([max_pool2d(taken, 2 * n + 1, stride=1, padding=n) for n in reach]).numpy() > 0


def cell_at(table: np.ndarray, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of a table at parts of a photo's width and height, in [0, 1)."""
    height, width = table.shape
    return np.minimum(down * height, height - 1).astype(int), np.minimum(across * width, width - 1).astype(int)
