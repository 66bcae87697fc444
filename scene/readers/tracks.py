"""Points in photos: the tracks of structure from motion, and projections of any points.

The rasterizer draws nothing nearer than NEAREST. A scene of a large unit has points that are nearer. It is trained,
saved and shown in that unit, but rendered with cameras and Gaussians enlarged by a power of two, which changes no digit
of float32: so depths from NEAREST / enlargement on are drawn.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.lens import Lens as NativeLens
from diff_gaussian_rasterization.lens import lens_of
from diff_gaussian_rasterization.reference.lens import numbers_of
from diff_gaussian_rasterization.scene import scene_arguments

from scene.colmap_loader import Camera
from scene.images.lens import PANORAMA, PERSPECTIVE, Lens, rays_of
from scene.readers.colmap import find_model, read_model
from scene.readers.info import NEAREST, CameraInfo, SceneInfo, as_camera_info
from scene.readers.scene_folder import COLMAP, kind_of

_FAR = 1.5  # sizes of the photo from its middle; undistortion moves 2D points out of it by less
FEWEST = 12  # points of a photo; fewer say too little of a pose
NEAR_SHARE = 0.01  # of the points in view; usual scenes have none nearer than NEAREST, and one with 0.026 lost 2.5 dB
_USUAL = 2.0  # depth that all but NEAR_SHARE of the points in view have in usual scenes: 2.2 to 3.6 in nine
_CAMERAS = 16  # whose depths are looked at
_SAMPLE = 5000  # points


class PhotoPoints(NamedTuple):
    """The 3D points (K, 3) float64 that a photo shows, in the training's frame, and their rays (K, 2), x / z and y / z.

    angular: a ray is the angle from the axis (radians) times the direction in the image, as a fisheye shows it: it may
    be 90 degrees or more. places (K, 2): in the photo, in parts of its width and height. errors: of reprojection, in
    pixels. lengths: photos that see the point. ranks: of the points' ids. These are (K,).
    """

    points: np.ndarray
    rays: np.ndarray
    places: np.ndarray
    errors: np.ndarray
    lengths: np.ndarray
    ranks: np.ndarray
    angular: bool = False


def read_tracks(scene: str | os.PathLike, views: Sequence[CameraInfo], offset: np.ndarray) -> list[PhotoPoints | None]:
    """Read the points that each view shows, from the tracks of a COLMAP model.

    A view of fewer than FEWEST points has None, and so have all views of scenes that are not COLMAP's.

    offset (3,): of the training's frame (scene/readers/info.py). UserError where the model cannot be read.
    """
    if kind_of(scene) != COLMAP:
        return [None] * len(views)
    folder, _ = find_model(Path(scene))
    cameras, images, points = read_model(folder, with_2d_points=True)
    photos, found, dropped = {image.name: image for image in images}, [], 0
    fisheyes = any(camera.model not in (*PERSPECTIVE, PANORAMA) for camera in cameras.values())
    if len(points.ids):
        every = np.concatenate([image.point3D_ids for image in images])
        lengths = np.bincount(np.searchsorted(points.ids, every[np.isin(every, points.ids)]), minlength=len(points.ids))
    for view in views:
        photo = photos.get(view.image_name)
        if photo is None or not len(points.ids) or cameras[photo.camera_id].model == PANORAMA:
            found.append(None)
            continue
        place = np.minimum(np.searchsorted(points.ids, photo.point3D_ids), len(points.ids) - 1)
        camera, angular = cameras[photo.camera_id], view.native is not None and view.native.chart == "equidistant"
        rays = _compute_angular_rays(camera, photo.xys) if angular else _compute_rays(camera, photo.xys, view)
        has_point = points.ids[place] == photo.point3D_ids
        places, longest = photo.xys / (camera.width, camera.height), max(camera.width, camera.height)
        errors, local = points.errors[place], (points.xyz[place] - offset) @ view.R + view.T
        if fisheyes:  # COLMAP gives 1e154 pixels, or a part of that, to a point that one shows beyond 90 degrees
            own = view.fx * np.linalg.norm(rays - rays_to(local, angular), axis=1)
            errors = np.where(np.abs(errors) <= longest, errors, own)
        visible, near = np.isfinite(rays).all(1), (np.abs(places - 0.5) < _FAR).all(1)
        sound = near & (np.abs(errors) <= longest)
        dropped += int((has_point & ~sound & (visible | ~near)).sum())
        taken = has_point & sound & visible
        place, places, errors = place[taken], places[taken], errors[taken]
        track = PhotoPoints(points.xyz[place] - offset, rays[taken], places, errors, lengths[place], place, angular)
        found.append(track if len(place) >= FEWEST else None)
    if dropped:
        fault = "lie far outside of their photo, or have a reprojection error that is larger than it or no number"
        print(f"{dropped} 2D points of {folder} are not used: they {fault}", file=sys.stderr)
    return found


def rays_to(local: np.ndarray, angular: bool) -> np.ndarray:
    """Rays (N, 2) of points (N, 3) of a view's frame, as `PhotoPoints` has them; NaN where there is none."""
    aside, z = local[:, :2], local[:, 2:]
    if not angular:
        return aside / np.where(z > 0, z, np.nan)
    away = np.linalg.norm(aside, axis=1, keepdims=True)
    return aside * np.where(away > 0, np.arctan2(away, z) / np.where(away > 0, away, 1.0), 0.0)


def _compute_angular_rays(camera: Camera, places: np.ndarray) -> np.ndarray:
    """Angular rays (N, 2) of a fisheye's places (N, 2); NaN where it shows nothing."""
    lens = lens_of(camera.model, tuple(map(float, camera.params)))
    return numbers_of(lens, torch.from_numpy(places - 0.5), camera.width, camera.height).numpy()


def _compute_rays(camera: Camera, places: np.ndarray, view: CameraInfo) -> np.ndarray:
    """Rays (N, 2) x / z and y / z of places (N, 2) in a camera's photo; NaN where there is none.

    Of a wide lens that is undistorted, those that the pinhole in its place shows: farther out, noise grows without end.
    """
    rays = rays_of(Lens(camera.model, tuple(map(float, camera.params)), camera.width, camera.height), places)
    if camera.model in PERSPECTIVE:
        return rays
    x, y = (rays * (view.fx, view.fy) + (view.cx, view.cy)).T
    visible = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    return np.where(visible[:, None], rays, np.nan)


def projected(camera: CameraInfo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel coordinates x, y of points (N, 3), and whether they are in front of the camera and inside its photo."""
    local = points @ camera.R + camera.T
    if camera.native:
        return _project_through_lens(camera.native, local, camera.width, camera.height)
    front = local[:, 2] > 0
    depth = np.where(front, local[:, 2], 1.0)
    x = camera.fx * local[:, 0] / depth + camera.cx
    y = camera.fy * local[:, 1] / depth + camera.cy
    return x, y, front & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


def _project_through_lens(
    lens: NativeLens, local: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`projected` of points in the camera's frame, by the rasterizer: it shows small Gaussians there."""
    means = torch.from_numpy(10 * local / np.linalg.norm(local, axis=1, keepdims=True))  # behind its near plane
    count, eye, zero = len(means), torch.eye(4, dtype=means.dtype), torch.zeros(3, dtype=means.dtype)
    ones = means.new_ones(count, 4)
    gaussians = Gaussians(means, ones[:, :1], scales=1e-3 * ones[:, :3], rotations=ones, colors=ones[:, :3])
    camera = GaussianRasterizationSettings(
        height, width, 1.0, 1.0, zero, 1.0, eye, eye, 0, zero, False, False, lens=lens
    )
    splats, _, _, tiles, _ = OPERATORS.project(*scene_arguments(gaussians, camera, raw=False))
    x, y = torch.where(tiles[:, None] > 0, splats[:, :2] + 0.5, -1).numpy().T
    return x, y, (x >= 0) & (x < width) & (y >= 0) & (y < height)


def enlargement(info: SceneInfo) -> float:
    """A power of two by which a scene is enlarged where it is drawn; 1 where at most a few points are too near."""
    depths = _collect_depths(info)
    usual = float(np.quantile(depths, NEAR_SHARE)) if len(depths) else NEAREST
    return 1.0 if usual >= NEAREST else float(2.0 ** np.ceil(np.log2(_USUAL / usual)))


def _collect_depths(info: SceneInfo) -> np.ndarray:
    """Depths of points, each in each photo that shows it; of a lens that is taken as it is, distances."""
    if info.point_cloud is None:
        return np.zeros(0)
    points = np.asarray(info.point_cloud.points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]  # a training refuses the others
    sample, views = points[:: -(-len(points) // _SAMPLE) or 1], info.train_cameras
    return np.concatenate([_find_depths(as_camera_info(view), sample) for view in views[:: -(-len(views) // _CAMERAS)]])


def _find_depths(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    local = points @ view.R + view.T
    depths = np.linalg.norm(local, axis=1) if view.native else local[:, 2]
    return depths[projected(view, points)[2] & (depths > 0)]
