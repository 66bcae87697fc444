# ruff: noqa: F401  (names of the reference, which other code imports from here)
"""Readers of datasets of all kinds: a folder becomes plain records."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from scene.images.masks import NO_MASKS, MaskOptions
from scene.readers.colmap import read_colmap
from scene.readers.info import HOLD, CameraInfo, SceneInfo, scene_extent
from scene.readers.point_cloud import fetchPly, storePly
from scene.readers.reference import (
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

# For other code to call, or to replace: Scene then calls what stands here in place of our readers.
sceneLoadTypeCallbacks: dict[str, Callable[..., SceneInfo]] = {
    COLMAP: readColmapSceneInfo,
    BLENDER: readNerfSyntheticInfo,
    NERFSTUDIO: readNerfstudioInfo,
}
_OURS = dict(sceneLoadTypeCallbacks)
_READERS: dict[str, Callable[..., SceneInfo]] = {
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
    kind: str | None = None,
    native: bool = False,
) -> SceneInfo:
    """Read the dataset in a folder, of any kind. UserError says what was looked for and what was found.

    images: folder of the photos (COLMAP only). hold_out: keep a test set apart, else all views train.
    init_pcd_path: points, or a file of them, to start from instead of the dataset's own. Without one, init_type
    decides: "sfm" (the dataset's points) or "random". want_cloud: False reads no points, for a model that exists
    already. offset: (3,) of that model's frame (scene/readers/world_offset.py); None: computed for this scene.
    kind: of the folder (`kind_of`), where it is known.
    native: take photos of distorting lenses as they are, where the rasterizer knows the camera model. Others are
    undistorted into the user's cache folder; nothing else is written.
    """
    start = StartOptions(init_pcd_path, init_type) if want_cloud else None
    kind = kind or kind_of(source_path)
    more = {"native": True} if native and kind != BLENDER else {}  # Blender's cameras have no lens
    info = _READERS[kind](Path(source_path), images, hold_out, start, masks, **more)
    return local(info, world_offset(info) if offset is None else np.asarray(offset, dtype=np.float64))


def replaced_reader(kind: str) -> Callable[..., SceneInfo] | None:
    """The reader that other code has put into `sceneLoadTypeCallbacks` for a kind of folder; None where ours stands."""
    read = sceneLoadTypeCallbacks.get(kind)
    return None if read is _OURS.get(kind) else read
