"""Readers of datasets of all kinds: a folder becomes plain records."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from scene.images.masks import NO_MASKS, MaskOptions
from scene.readers.colmap import read_colmap
from scene.readers.info import HOLD, CameraInfo, SceneInfo, scene_extent
from scene.readers.point_cloud import fetchPly, storePly
from scene.readers.reference_readers import (
    getNerfppNorm,
    readCamerasFromTransforms,
    readColmapCameras,
    readColmapSceneInfo,
    readNerfstudioInfo,
    readNerfSyntheticInfo,
)
from scene.readers.scene_folder import BLENDER, COLMAP, NERFSTUDIO, kind_of
from scene.readers.start_cloud import SFM, StartOptions
from scene.readers.transforms import read_blender, read_nerfstudio
from scene.readers.world_offset import local, world_offset
from utils.graphics_utils import BasicPointCloud, focal2fov, fov2focal
from utils.system_utils import UserError

__all__ = [
    "HOLD",
    "BasicPointCloud",
    "CameraInfo",
    "SceneInfo",
    "fetchPly",
    "focal2fov",
    "fov2focal",
    "getNerfppNorm",
    "readCamerasFromTransforms",
    "readColmapCameras",
    "readColmapSceneInfo",
    "readNerfSyntheticInfo",
    "readNerfstudioInfo",
    "read_by_callback",
    "read_scene",
    "sceneLoadTypeCallbacks",
    "scene_extent",
    "storePly",
]

# For other code to call, or to replace: Scene then calls what stands here in place of read_scene.
sceneLoadTypeCallbacks: dict[str, Callable[..., SceneInfo]] = {
    COLMAP: readColmapSceneInfo,
    BLENDER: readNerfSyntheticInfo,
    NERFSTUDIO: readNerfstudioInfo,
}
_OURS = dict(sceneLoadTypeCallbacks)
_READERS: dict[str, Callable[[Path, str, bool, StartOptions | None, MaskOptions], SceneInfo]] = {
    COLMAP: read_colmap,
    BLENDER: read_blender,
    NERFSTUDIO: read_nerfstudio,
}


def read_scene(
    source_path: str | os.PathLike,
    images: str,
    hold_out: bool,
    init_pcd_path: str | BasicPointCloud = "",
    want_cloud: bool = True,
    init_type: str = SFM,
    masks: MaskOptions = NO_MASKS,
    offset: Sequence[float] | None = None,
) -> SceneInfo:
    """Read the dataset in a folder, of any kind. UserError says what was looked for and what was found.

    images: folder of the photos (COLMAP only). hold_out: keep a test set apart, else all views train.
    init_pcd_path: points, or a file of them, to start from instead of the dataset's own. Without one, init_type
    decides: "sfm" (the dataset's points) or "random". want_cloud: False reads no points, for a model that exists
    already. offset: (3,) of that model's frame (scene/readers/world_offset.py); None: computed for this scene.
    Photos of distorting lenses are undistorted into the user's cache folder; nothing else is written.
    """
    folder = Path(source_path)
    if not str(source_path):
        raise UserError("no scene folder given; name it with -s")
    kind = kind_of(folder)
    start = StartOptions(init_pcd_path, init_type) if want_cloud else None
    info = _READERS[kind](folder, images, hold_out, start, masks)
    return local(info, world_offset(info) if offset is None else np.asarray(offset, dtype=np.float64))


def read_by_callback(
    source_path: str | os.PathLike, images: str, white_background: bool, depths: str, hold_out: bool, halves: bool
) -> SceneInfo | None:
    """The scene by the reader that other code has put into `sceneLoadTypeCallbacks`; None where ours stand.

    It is called with the reference's arguments, and may return any record with the fields that a release of the
    reference has. halves: the half-image protocol, train_test_exp.
    """
    kind = kind_of(Path(source_path)) if str(source_path) else None
    read = sceneLoadTypeCallbacks.get(kind)
    if read is _OURS.get(kind):
        return None
    if kind == COLMAP:
        info = read(str(source_path), images, depths, hold_out, halves)
    else:
        info = read(str(source_path), white_background, depths, hold_out)
    if isinstance(info, SceneInfo):
        return info
    return SceneInfo(
        info.point_cloud,
        info.train_cameras,
        info.test_cameras,
        info.nerf_normalization,
        info.ply_path,
        getattr(info, "is_nerf_synthetic", kind == BLENDER),  # unknown to the release of 2023
    )
