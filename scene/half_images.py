"""The half-image protocol (--train_test_exp): test photos train with their left half, and their right half is scored.

So the exposures of test photos are known without training on the pixels that are scored.
"""

import os
from dataclasses import replace

from scene.readers.info import SceneInfo, normalization


def half(width: int, of_test_view: bool) -> slice:
    """Columns of the half that counts: the right one of views in the test list, else the left one."""
    return slice(width // 2, width) if of_test_view else slice(0, width // 2)


def train_on_all(info: SceneInfo) -> SceneInfo:
    """The scene with its test views among the training views, too: sorted by name, or appended if names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return replace(info, train_cameras=views, nerf_normalization=normalization(views, points))
