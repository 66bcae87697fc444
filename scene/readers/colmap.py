"""COLMAP scenes: a model in the folder sparse, photos in a folder beside it."""

import os
import sys
from pathlib import Path

import numpy as np

from scene.images.find import find_pictures
from scene.images.masks import NO_MASKS, MaskOptions, find_masks
from scene.readers import colmap_model
from scene.readers.info import SceneInfo, normalization, split_by_order
from scene.readers.point_cloud import check_finite, read_point_cloud
from scene.readers.source_views import SourceView, make_cameras
from scene.readers.start_cloud import OWN_POINTS, StartCloud, StartOptions, choose_start, random_in_frusta
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError


def read_colmap(
    folder: Path,
    images: str,
    hold_out: bool,
    start: StartOptions | None = OWN_POINTS,
    masks: MaskOptions = NO_MASKS,
) -> SceneInfo:
    """Read a COLMAP scene: the model, photos in `<folder>/<images>`, views sorted by name (bytes).

    Arguments and errors as for `scene.dataset_readers.read_scene`; start None: without points.
    """
    model_folder, model = colmap_model.find_model(folder)
    if not model.views:
        raise UserError(f"the COLMAP model in {model_folder} has no registered photo; reconstruct the scene again")
    views = sorted(model.views, key=lambda view: os.fsencode(view.name))
    names = [view.name for view in views]
    listed_by = f"the COLMAP model in {model_folder}"
    paths = find_pictures(folder / images, names, listed_by, "put them there, or name their folder with -i")
    found = find_masks(folder, names, masks)
    cameras = make_cameras(
        [
            SourceView(view.name, path, view.camera_id, view.lens, view.rotation, view.translation, mask)
            for view, path, mask in zip(views, paths, found, strict=True)
        ],
        masks.ignore_alpha,
    )
    train, test = split_by_order(cameras, hold_out, folder)
    if start is None:
        return SceneInfo(None, train, test, normalization(train), None)
    cloud, ply_path = choose_start(
        start, lambda: _own_cloud(model_folder, model), lambda: random_in_frusta(train), f"{listed_by} has no points"
    )
    return SceneInfo(cloud, train, test, normalization(train, cloud.points), ply_path)


def _own_cloud(model_folder: Path, model: colmap_model.ColmapModel) -> StartCloud:
    ply_path = _fresh_ply(model_folder)
    if ply_path:
        return StartCloud(read_point_cloud(ply_path), ply_path)
    check_finite(model.points, colmap_model.points_file(model_folder))
    colors = model.colors.astype(np.float32) / 255
    return StartCloud(BasicPointCloud(model.points, colors, np.zeros_like(colors)), None)


def _fresh_ply(model_folder: Path) -> Path | None:
    ply = model_folder / "points3D.ply"
    if not ply.is_file():
        return None
    source = colmap_model.points_file(model_folder)
    if ply.stat().st_mtime >= source.stat().st_mtime:
        return ply
    print(f"{ply} is older than {source.name} and is not used; to use it, give --init_pcd_path {ply}", file=sys.stderr)
    return None
