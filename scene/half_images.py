"""The half-image protocol (--train_test_exp): test photos train with their left half, and their right half is scored.

So the exposures of test photos are known without training on the pixels that are scored.
"""

import os
from collections.abc import Sequence
from dataclasses import replace

from scene.cameras import Camera
from scene.readers.info import CameraInfo, SceneInfo, exposure_names, normalization


def train_on_all(info: SceneInfo) -> SceneInfo:
    """The scene with its test views among the training views, too: sorted by name, or appended if names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return replace(info, train_cameras=views, nerf_normalization=normalization(views, points))


def mark_halves(train: list[Camera], test: list[Camera], infos: Sequence[CameraInfo]) -> None:
    """Set the columns that count and the exposure names in the cameras of a scene made by `train_on_all`.

    infos: of the training views.
    """
    tested = {camera.image_path for camera in test}
    names = {info.image_path: name for info, name in zip(infos, exposure_names(infos), strict=True)}
    for camera in train:
        if camera.image_path in tested:
            camera.columns = slice(0, camera.image_width // 2)
    for camera in test:
        camera.columns = slice(camera.image_width // 2, camera.image_width)  # utils.image_utils.right_half
    for camera in train + test:
        camera.exposure_name = names[camera.image_path]
