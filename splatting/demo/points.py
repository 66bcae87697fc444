"""Points on the surfaces of a scene as structure from motion would find them, and their COLMAP model.

The points are noisy and coloured, and have their tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image  # noqa: F401  before pycolmap: unless Pillow's zlib is loaded first, writing PNGs aborts

from splatting.demo.objects import Thing
from splatting.demo.tracer import View, trace

POSITION_NOISE = 0.004  # standard deviation of a point, as a fraction of its distance from the view that found it
PIXEL_NOISE = 0.3  # standard deviation of an observation in pixels
MIN_TRACK = 3  # least number of views that see a point


@dataclass(frozen=True)
class SurfacePoints:
    """Coloured points and their observations in the views."""

    xyz: np.ndarray  # (N, 3), world units
    rgb: np.ndarray  # (N, 3) uint8
    seen: list[np.ndarray]  # for each view, the indices (K,) of the points that it sees
    keypoints: list[np.ndarray]  # for each view, their observed positions (K, 2) in pixels; pixel centres are at .5


def _found_by_views(
    things: list[Thing], views: list[View], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return surface points (3, count) under random pixels of random views, and their distances (count,)."""
    owner = np.sort(rng.integers(len(views), size=count))
    u, v = rng.uniform(size=(2, count))
    points = np.empty((3, count))
    distance = np.empty(count)
    for k, view in enumerate(views):
        mine = np.flatnonzero(owner == k)
        direction = view.rays(u[mine] * view.width, v[mine] * view.height)
        origin = view.center.reshape(3, 1)
        distance[mine], _ = trace(things, origin.astype(np.float32), direction)
        points[:, mine] = origin + distance[mine] * direction
    return points, distance


def _visible(things: list[Thing], view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (K,) of the surface points (3, N) that a view sees, and their image positions (K, 2)."""
    x, y, z = view.project(points)
    inside = np.flatnonzero((z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height))
    origin = view.center.reshape(3, 1)
    offset = points[:, inside] - origin
    distance = np.linalg.norm(offset, axis=0)
    hit, _ = trace(things, origin.astype(np.float32), (offset / distance).astype(np.float32))
    # Hits on a slanted surface move by far more than float32's rounding. All objects are much thicker than 0.02.
    near = hit > distance - 0.02
    return inside[near], np.stack([x, y], axis=1)[inside[near]]


def sample_points(
    things: list[Thing], views: list[View], pictures: list[np.ndarray], count: int, rng: np.random.Generator
) -> SurfacePoints:
    """Sample about `count` surface points with true visibility; drop points that fewer than MIN_TRACK views see.

    pictures: the views' photos, (H, W, 3) uint8. A point's colour is its mean over the photos that see it, so it does
    not depend on the view.
    """
    points, distance = _found_by_views(things, views, count, rng)
    seen, exact = zip(*(_visible(things, view, points) for view in views), strict=True)
    track = np.bincount(np.concatenate(seen), minlength=count)
    colour = np.zeros((count, 3))
    for index, place, picture in zip(seen, exact, pictures, strict=True):
        column, row = place.astype(int).T
        colour[index] += picture[row, column]
    keep = track >= MIN_TRACK
    renumber = np.cumsum(keep) - 1
    xyz = points.T + rng.normal(size=(count, 3)) * (POSITION_NOISE * distance)[:, None]
    noisy = [place + rng.normal(scale=PIXEL_NOISE, size=place.shape) for place in exact]
    return SurfacePoints(
        xyz=xyz[keep],
        rgb=np.floor(colour[keep] / track[keep, None] + 0.5).astype(np.uint8),
        seen=[renumber[index[keep[index]]] for index in seen],
        keypoints=[place[keep[index]] for index, place in zip(seen, noisy, strict=True)],
    )


def write_model(folder: Path, names: list[str], views: list[View], points: SurfacePoints) -> None:
    """Make `folder` with a binary COLMAP model: one PINHOLE camera, an image per view, points with their tracks."""
    import pycolmap

    first = views[0]
    model = pycolmap.Reconstruction()
    params = [first.focal, first.focal, first.width / 2, first.height / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=first.width, height=first.height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points.xyz]
    for image_id, (name, view) in enumerate(zip(names, views, strict=True), 1):
        image = pycolmap.Image(name=name, keypoints=points.keypoints[image_id - 1], camera_id=1, image_id=image_id)
        translation = -view.rotation @ view.center
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(view.rotation), translation))
        for place, index in enumerate(points.seen[image_id - 1]):
            tracks[index].add_element(image_id, place)
    for xyz, track, rgb in zip(points.xyz, tracks, points.rgb, strict=True):
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(folder)
