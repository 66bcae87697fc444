"""A colour correction of each training photo (--train_test_exp), trained with the Gaussians, as in the reference."""

import argparse
import os
from collections.abc import Sequence
from typing import Any

from scene.cameras import Camera
from scene.dataset_readers import find_reader_replacement
from scene.readers.info import CameraInfo, SceneInfo, names_of_photos, normalization
from scene.readers.scene_folder import kind_of
from scene.scene import Scene, load_exposures, save_exposures
from splatting.part import Appearance, Needs
from utils.image_utils import half


class Exposure(Appearance):
    """Trains the model's exposures by the half-image protocol.

    The left half of a test photo trains, too, and the right half is scored. So the exposure of the photo is known,
    without training on the pixels that are scored.
    """

    name = "exposure"
    kind = "affine"
    flag = "train_test_exp"
    needs = Needs(length=True)  # for its learning rate

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        by_other_code = find_reader_replacement(kind_of(args.source_path))  # which gets the option as an argument
        return info if by_other_code else train_on_all(info)

    def cameras(self, scene: Scene, cameras: Sequence[tuple[Camera, CameraInfo]], held_out: bool) -> None:
        """Let test views train or be scored on one half of their columns, and name the exposures of renamed views."""
        scene.halves = True
        names, tested = names_of_photos(scene.info), {view.image_path for view in scene.info.test_cameras}
        for camera, view in cameras:
            if (name := names.get(view.image_path, view.image_name)) != view.image_name:
                camera.exposure_name = name
            if view.image_path in tested:
                camera.columns = half(camera.image_width, held_out)

    def begin(self, run: Any, state: Any) -> None:
        run.gaussians.exposures.applied = True
        if run.start and state is None:
            print(f"{run.start} has no exposures; all photos start without a correction")

    def save(self, scene: Scene) -> None:
        save_exposures(scene.gaussians, scene.model_path)

    def load(self, scene: Scene, args: argparse.Namespace) -> None:
        load_exposures(scene)


def train_on_all(info: SceneInfo) -> SceneInfo:
    """Return the scene with its test views added to the training views: sorted by name, or appended if names clash."""
    views = info.train_cameras + info.test_cameras
    if len({view.image_name for view in views}) == len(views):
        views.sort(key=lambda view: os.fsencode(view.image_name))
    points = None if info.point_cloud is None else info.point_cloud.points
    return info._replace(train_cameras=views, nerf_normalization=normalization(views, points))
