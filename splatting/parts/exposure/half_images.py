"""The training views of the half-image protocol."""

import os
from dataclasses import replace

from scene.readers.info import SceneInfo, normalization


def train_on_all(info: SceneInfo) -> SceneInfo:
    """The scene with its test views among the training views, too: sorted by name, or appended if names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return replace(info, train_cameras=views, nerf_normalization=normalization(views, points))
