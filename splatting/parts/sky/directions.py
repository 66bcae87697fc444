"""Directions of the sky: smooth, of one colour in all photos, without points, above the horizon, and far away.

A wall of one colour has no points either. But it is near: its edges move against the directions from photo to photo, so
the colours of all photos agree better on a sphere of about its distance than far away.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from scene.cameras import Camera
from scene.readers.info import CameraInfo
from scene.readers.tracks import projected
from scene.scene import Scene
from utils.graphics_utils import BasicPointCloud
from utils.image_utils import as_float

FEWEST = 0.03  # of the directions that several photos show; with fewer there is no sky
FEWEST_POINTS = 2000  # with fewer, a place without points says nothing
ALIKE = 0.1  # standard deviation of a direction's colours over the photos, at most, on the mean of the channels
ACROSS = 64  # Gaussians of the sky, and cells, across a photo
_SMOOTH = 0.04  # standard deviation of a photo over three by three cells, at most, on the mean of the channels
_AROUND = 1, 4  # cells around a point that are not the sky's, and that do not tell of one, at least
_SPACINGS = 1.0, 2.0  # the same in mean distances of a photo's points: by chance 0.01 % of places have none in two
_BELOW = -0.2  # sine of the elevation: a sky ends below the horizon where the ground ends
_UNTURNED = 0.05  # weight of the photos' own upward axes where their sideward axes do not tell what is up
_NEARER = 1.0, 1.5, 2.2, 3.3, 5.0, 7.5  # extents: distances of walls
_BETTER = 0.5  # mean square of the colours' differences there, as a part of that far away, at most: it is a wall
_NOISE = 1e-4  # of that mean square: of the photos
_MOST = 200_000  # directions all around


class _Photo(NamedTuple):
    """A photo in cells (h, w): colours (h, w, 3), which cells count, are near points (2, h, w), and are smooth."""

    view: CameraInfo
    colors: np.ndarray
    counts: np.ndarray
    near: np.ndarray
    smooth: np.ndarray


class _Seen(NamedTuple):
    """What photos show at places (N,): how many photos, with a point near by (2, N), smooth, colours (N, 3), squares.

    squares: the mean squared difference of the colours from their mean, on the mean of the channels.
    """

    photos: np.ndarray
    taken: np.ndarray
    smooth: np.ndarray
    colors: np.ndarray
    squares: np.ndarray


def find_directions(scene: Scene, center: list[float], radius: float) -> tuple[BasicPointCloud, float]:
    """Points of a sky on a sphere, and their share of the directions that two or more training photos show.

    A direction is the sky's if no photo that shows it has a point near by, and all have the same colour there. The
    share counts only those above the horizon, which are smooth. It is 0 with fewer than FEWEST_POINTS points, and where
    the photos agree better nearer by.
    """
    info = scene.info
    photos = [_photo(camera, info.train_cameras[camera.uid], info.point_cloud.points)
              for camera in sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)]  # fmt: skip
    toward = _directions(info.train_cameras)
    shell, height = center + radius * toward, toward @ _up(info.train_cameras)
    seen = _look(photos, shell)
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
    """Whether photos agree better on what is in some directions, where they have no points, if it is near."""
    far = _look(photos, center + radius * toward, without_points=True)
    for times in _NEARER:
        near = _look(photos, center + times * extent * toward, without_points=True)
        both = (far.photos > 1) & (near.photos > 1)
        if both.any() and near.squares[both].mean() + _NOISE < _BETTER * (far.squares[both].mean() + _NOISE):
            return True
    return False


def _look(photos: list[_Photo], places: np.ndarray, without_points: bool = False) -> _Seen:
    """What photos show at places (N, 3). without_points: leave out what is near points in a photo."""
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


def _directions(views: list[CameraInfo]) -> np.ndarray:
    """Unit vectors (N, 3) all around, ACROSS over the width of a photo: a Fibonacci lattice (Gonzalez 2010)."""
    apart = float(np.median([view.width / view.fx for view in views])) / ACROSS
    count = min(int(4 * math.pi / (0.75**0.5 * apart**2)), _MOST)
    place = np.arange(count) + 0.5
    height, turn = 1 - 2 * place / count, math.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], axis=1)


def _up(views: list[CameraInfo]) -> np.ndarray:
    """What is up (3,): across the photos' sideward axes, which photographers hold level, as far as these differ."""
    axes = np.stack([view.R for view in views])
    sideward, upward = axes[:, :, 0], -axes[:, :, 1].mean(0)
    up = np.linalg.solve(sideward.T @ sideward / len(views) + _UNTURNED * np.eye(3), upward)
    return up / max(np.linalg.norm(up), 1e-12)


def _photo(camera: Camera, view: CameraInfo, points: np.ndarray) -> _Photo:
    """A photo in cells, ACROSS over its width; cells count where all their pixels count and are opaque."""
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
    smooth = (square - mean**2).clamp_min(0).mean(0).sqrt() < _SMOOTH
    counts, smooth = (values.cpu().numpy() for values in (counts[0] == 1, smooth))
    return _Photo(view, cells.permute(1, 2, 0).cpu().numpy(), counts, _near_points(view, points), smooth)


def _near_points(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    """Cells of a photo that have a point near by, as near as _AROUND and _SPACINGS say, (2, h, w) bool."""
    cells = np.zeros((max(view.height * ACROSS // view.width, 1), ACROSS), dtype=bool)
    x, y, inside = projected(view, points.astype(np.float64))
    if not inside.any():
        return np.ones((2, *cells.shape), dtype=bool)
    cells[cell_at(cells, x[inside] / view.width, y[inside] / view.height)] = True
    taken, spacing = torch.from_numpy(cells)[None].float(), math.sqrt(cells.size / inside.sum())
    reach = [max(least, round(times * spacing)) for least, times in zip(_AROUND, _SPACINGS, strict=True)]
    return torch.cat([max_pool2d(taken, 2 * n + 1, stride=1, padding=n) for n in reach]).numpy() > 0


def cell_at(table: np.ndarray, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a table at parts of a photo's width and height, in [0, 1)."""
    height, width = table.shape
    return np.minimum(down * height, height - 1).astype(int), np.minimum(across * width, width - 1).astype(int)
