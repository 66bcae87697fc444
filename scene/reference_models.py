"""The part of a model that a scene needs: of ours, or of the reference's class of that name."""

import inspect
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from scene.readers.info import CameraInfo
from scene.saved_iterations import saved_ply
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import atomic_write


class SceneGaussians(Protocol):
    """The part of GaussianModel that a scene needs, or the reference's class of that name.

    A scene sets `world_offset` and `enlargement`, and calls `load_exposures(folder, cam_infos)` and
    `save_exposures(folder)` with train_test_exp if there are such methods. Else it calls `load_ply(path, True)`, and
    writes exposure.json from `exposure_mapping` and `get_exposure_from_name(name)`, as the reference does.
    """

    def create_from_pcd(
        self, pcd: BasicPointCloud, cam_infos: Sequence[CameraInfo], spatial_lr_scale: float
    ) -> None: ...

    def load_ply(self, path: str) -> None: ...

    def save_ply(self, path: str) -> None: ...


def call_of_either_form(function: Callable, newer: tuple, older: tuple) -> Any:
    """Call a function that other code may have replaced by one of 2023, which takes fewer arguments."""
    try:
        inspect.signature(function).bind(*newer)
    except TypeError:
        return function(*older)
    return function(*newer)


def load_exposures(scene: Any) -> None:
    """Load the exposures of a scene's training views, whose PLY is loaded; the reference's model reads both at once."""
    if load := getattr(scene.gaussians, "load_exposures", None):
        load(scene.model_path, scene.info.train_cameras)
    else:
        scene.gaussians.load_ply(str(saved_ply(scene.model_path, scene.loaded_iter)), True)


def save_exposures(gaussians: SceneGaussians, folder: str | os.PathLike) -> None:
    """Write exposure.json into a model folder, also for a model that cannot do so itself."""
    if save := getattr(gaussians, "save_exposures", None):
        save(folder)
    elif names := list(getattr(gaussians, "exposure_mapping", ())):
        table = {name: gaussians.get_exposure_from_name(name).tolist() for name in names}
        with atomic_write(Path(folder) / "exposure.json") as path:
            path.write_text(json.dumps(table, indent=2), encoding="utf-8")
