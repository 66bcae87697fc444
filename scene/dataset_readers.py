"""Readers of datasets: folders to plain records, whichever kind they are."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from scene.pictures.masks import NO_MASKS, MaskOptions
from scene.readers.colmap import readColmapSceneInfo
from scene.readers.records import HOLD, CameraInfo, SceneInfo, scene_extent
from scene.readers.scene_folder import BLENDER, COLMAP, NERFSTUDIO, kind_of
from scene.readers.start_cloud import SFM, StartOptions
from scene.readers.transforms import readNerfstudioInfo, readNerfSyntheticInfo
from scene.readers.world_offset import local, world_offset
from utils.system_utils import UserError

__all__ = [
    "HOLD",
    "CameraInfo",
    "SceneInfo",
    "readColmapSceneInfo",
    "readNerfSyntheticInfo",
    "readNerfstudioInfo",
    "read_scene",
    "sceneLoadTypeCallbacks",
    "scene_extent",
]

sceneLoadTypeCallbacks: dict[str, Callable[[Path, str, bool, StartOptions | None, MaskOptions], SceneInfo]] = {
    COLMAP: readColmapSceneInfo,
    BLENDER: readNerfSyntheticInfo,
    NERFSTUDIO: readNerfstudioInfo,
}


def read_scene(
    source_path: str | os.PathLike,
    images: str,
    hold_out: bool,
    init_pcd_path: str = "",
    want_cloud: bool = True,
    init_type: str = SFM,
    masks: MaskOptions = NO_MASKS,
    offset: Sequence[float] | None = None,
) -> SceneInfo:
    """Read the dataset in a folder, whichever kind it is. UserError says what was looked for and what was found.

    images: folder of the pictures (COLMAP only). hold_out: keep a test set apart, else everything trains.
    init_pcd_path: file of points to start from instead of the dataset's own; else init_type, "sfm" (those) or "random".
    want_cloud: without, points are not judged, for a model that is there already.
    offset: (3,) of the frame of that model (scene/readers/world_offset.py); None: found for this scene.
    Pictures of distorting lenses are undistorted into the user's cache folder; nothing else is written.
    """
    folder = Path(source_path)
    if not str(source_path):
        raise UserError("no scene folder given; name it with -s")
    kind = kind_of(folder)
    start = StartOptions(init_pcd_path, init_type) if want_cloud else None
    info = sceneLoadTypeCallbacks[kind](folder, images, hold_out, start, masks)
    return local(info, world_offset(info) if offset is None else np.asarray(offset, dtype=np.float64))
