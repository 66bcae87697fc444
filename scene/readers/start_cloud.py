"""The points that training starts from: the scene's own, a file's, or random ones."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene.readers.info import CameraInfo, SceneInfo, camera_centers, normalization, scene_extent
from scene.readers.point_cloud import is_ply, read_point_cloud
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

SFM = "sfm"
RANDOM = "random"
RANDOM_POINTS = 100_000
RANDOM_HALF_SIZE = 1.3  # the NeRF-synthetic objects lie within this cube
_NEAREST, _FARTHEST = 0.25, 2.5  # depths of random points, as parts of the distance from cameras to their focus
_GREY = 127 / 255
_CUBE = 0.45  # half of the cube as a part of the photo's width, where NeRF-synthetic cameras see it
_OFF, _LARGER = 0.5, 1.5  # departures from those: half sizes of the cube, and a factor
# Mean squared sine of the angles between optical axes, about, below which they have no focus: 1.8 degrees.
_PARALLEL = 1e-3


class StartOptions(NamedTuple):
    """The user's choice of points: given ones or a file (empty: none), else SFM (the scene's own) or RANDOM ones."""

    points: str | BasicPointCloud = ""
    kind: str = SFM


OWN_POINTS = StartOptions()


class StartCloud(NamedTuple):
    """Points, and the PLY they come from; None for points of another kind of file or of none. is_random: made here."""

    cloud: BasicPointCloud | None
    ply_path: Path | None
    is_random: bool = False


def scene_info(
    views: tuple[list[CameraInfo], list[CameraInfo]],
    options: StartOptions | None,
    own: Callable[[], StartCloud | None],
    random: Callable[[], BasicPointCloud],
    lacking: str,
    is_nerf_synthetic: bool = False,
) -> SceneInfo:
    """The dataset of training and test views with its start cloud; options None: without one.

    own: reads the scene's points, if it has any; lacking: start of the message when it has none. random: makes others.
    """
    start = StartCloud(None, None) if options is None else _choose_cloud(options, own, random, lacking)
    points = None if start.cloud is None else start.cloud.points
    size = normalization(views[0], points)
    return SceneInfo(start.cloud, *views, size, start.ply_path, is_nerf_synthetic, has_random_points=start.is_random)


def _choose_cloud(
    options: StartOptions, own: Callable[[], StartCloud | None], random: Callable[[], BasicPointCloud], lacking: str
) -> StartCloud:
    """Return the points that the options choose. own, random, lacking: see `scene_info`."""
    if isinstance(options.points, BasicPointCloud):
        return StartCloud(options.points, None)
    if options.points:
        path = Path(options.points)
        return StartCloud(read_point_cloud(path), path if is_ply(path) else None)
    if options.kind == RANDOM:
        return StartCloud(random(), None, is_random=True)
    start = own()
    if start is None or not len(start.cloud.points):
        raise UserError(
            f"{lacking}; start from random points with --init_type {RANDOM}, or from a file with --init_pcd_path"
        )
    return start


def random_for_blender(cameras: list[CameraInfo], source: object) -> BasicPointCloud:
    """Make grey points, spread evenly over the reference's cube around the origin if the cameras look at that cube.

    If the cameras look at another place, or at one of another size, the points are in a cube there. If the cameras look
    at no common place, the points are those of `random_in_frusta`. A message says so in both cases.

    source: file of the cameras, for the message.
    """
    turns, moves = np.array([camera.R for camera in cameras]), np.array([camera.T for camera in cameras])
    widths = np.array([camera.width / camera.fx for camera in cameras])
    sizes = RANDOM_HALF_SIZE / np.maximum(moves[:, 2] * widths, 1e-9) / _CUBE
    aside = np.linalg.norm(moves[:, :2], axis=1) > _OFF * RANDOM_HALF_SIZE
    if np.median(aside | (sizes < 1 / _LARGER) | (sizes > _LARGER)) == 0:
        return _fill_cube(np.zeros(3), RANDOM_HALF_SIZE)
    said = f"the cameras of {source} do not look at the cube of {2 * RANDOM_HALF_SIZE:g} units around the origin that"
    said += " those of Blender scenes look at, so random points are put"
    focus = nearest_to_axes(camera_centers(cameras), turns[:, :, 2])
    if focus and focus[1] < scene_extent(cameras):
        middle, half = focus[0], _CUBE * focus[1] * float(np.median(widths))
        print(f"{said} into a cube of {2 * half:.3g} around the place that they look at", file=sys.stderr)
        return _fill_cube(middle, half)
    print(f"{said} into the views; their axes must be those of OpenGL, y up and z backward", file=sys.stderr)
    return random_in_frusta(cameras)


def _fill_cube(middle: np.ndarray, half: float) -> BasicPointCloud:
    return _make_grey(np.random.default_rng(0).uniform(-half, half, (RANDOM_POINTS, 3)) + middle)


def random_in_frusta(cameras: list[CameraInfo]) -> BasicPointCloud:
    """Grey points in the cameras' frusta: each in a random pixel of a random view, at an even random depth.

    Depths are relative to the cameras' median distance from their focus, the point nearest to all optical axes. If the
    axes are parallel or diverge, the extent of the cameras takes the place of that distance.
    """
    random = np.random.default_rng(0)
    chosen = random.integers(len(cameras), size=RANDOM_POINTS)
    x, y = random.uniform(size=(2, RANDOM_POINTS))
    depth = _measure_focus_distance(cameras) * random.uniform(_NEAREST, _FARTHEST, RANDOM_POINTS)
    points = np.empty((RANDOM_POINTS, 3))
    for index, camera in enumerate(cameras):
        mine = chosen == index
        across = (x[mine] * camera.width - camera.cx) / camera.fx
        down = (y[mine] * camera.height - camera.cy) / camera.fy
        local = [across, down, np.ones(mine.sum())]
        if camera.native and camera.native.chart == "equirectangular":
            local = [np.sin(across) * np.cos(down), np.sin(down), np.cos(across) * np.cos(down)]
        local = np.stack(local, axis=1) * depth[mine, None]
        points[mine] = local @ camera.R.T + camera.center
    return _make_grey(points)


def _measure_focus_distance(cameras: list[CameraInfo]) -> float:
    extent = scene_extent(cameras)
    focus = nearest_to_axes(camera_centers(cameras), np.array([camera.R[:, 2] for camera in cameras]))
    return focus[1] if focus and focus[1] > 0.1 * extent else extent


def nearest_to_axes(centers: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The point (3,) nearest to the optical axes (N, 3) of cameras, and their median distance from it along these.

    None where the axes are within about 2 degrees of each other, or the point is behind most cameras. Least squares:
    the sum of (I - a aᵀ) (x - c) over the axes a from centers c is zero (Traa, "Least-squares intersection of lines",
    2013).
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] <= _PARALLEL * len(axes):
        return None
    focus = np.linalg.solve(normal, (across @ centers[:, :, None]).sum(axis=0)[:, 0])
    distance = float(np.median(((focus - centers) * axes).sum(axis=1)))
    return (focus, distance) if distance > 0 else None


def _make_grey(points: np.ndarray) -> BasicPointCloud:
    grey = np.full(points.shape, _GREY, dtype=np.float32)
    return BasicPointCloud(points, grey, np.zeros_like(grey))
