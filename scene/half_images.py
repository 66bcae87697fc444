"""The half-image protocol (--train_test_exp): every picture trains, of test pictures the left half, whose right half is
scored, so that the exposures of test pictures are known without training on what is scored.
"""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scene.cameras import Camera
from scene.dataset_readers import CameraInfo, SceneInfo, scene_extent


def train_on_all(info: SceneInfo) -> SceneInfo:
    """The scene with its test views among the training views, too: by name, or behind them where names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return replace(info, train_cameras=views, extent=scene_extent(views, points))


def exposure_names(cameras: Sequence[CameraInfo]) -> list[str]:
    """A name for each view: its image name, or where several have that (Blender's train/r_0 and test/r_0) its path from
    their common folder.
    """
    counts = Counter(camera.image_name for camera in cameras)
    folder = os.path.commonpath([camera.image_path.parent for camera in cameras]) if cameras else ""
    paths = [Path(os.path.relpath(camera.image_path, folder)).as_posix() for camera in cameras]
    return [c.image_name if counts[c.image_name] == 1 else path for c, path in zip(cameras, paths, strict=True)]


def mark_halves(train: list[Camera], test: list[Camera], infos: Sequence[CameraInfo]) -> None:
    """Tell cameras of a scene of `train_on_all` which columns count in each, and their names among the exposures.

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
