"""The half-image protocol (--train_test_exp): test photos train with their left half, and their right half is scored.

So the exposures of test photos are known without training on the pixels that are scored.
"""

import os
from collections.abc import Sequence
from dataclasses import replace

from scene.cameras import Camera
from scene.readers.info import CameraInfo, SceneInfo, exposure_names, normalization
from scene.views.view import half


def train_on_all(info: SceneInfo) -> SceneInfo:
    """The scene with its test views among the training views, too: sorted by name, or appended if names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return replace(info, train_cameras=views, nerf_normalization=normalization(views, points))


def mark_halves(cameras: Sequence[Camera], views: Sequence[CameraInfo], info: SceneInfo, in_test_list: bool) -> None:
    """Set the columns that count in the cameras of a scene made by `train_on_all`.

    Where names clash, set exposure names, too. views: of these cameras, in their order. in_test_list: they are the test
    list, else the training list.
    """
    tested = {view.image_path for view in info.test_cameras}
    paths = [view.image_path for view in info.train_cameras]
    names = dict(zip(paths, exposure_names(info.train_cameras), strict=True))
    for camera, view in zip(cameras, views, strict=False):
        if isinstance(camera, Camera):  # code of others may replace utils.camera_utils.loadCam
            if (name := names.get(view.image_path, view.image_name)) != view.image_name:
                camera.exposure_name = name
            if view.image_path in tested:
                camera.columns = half(camera.image_width, in_test_list)
