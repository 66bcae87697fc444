"""Splats of a file in a scene: the start of a training, or other people's models in our views."""

import argparse
import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from exports.of_model import fill_model, model_of
from exports.read import is_point_cloud, read_splats
from exports.selection import drawable, selected
from exports.splats import Splats
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.graphics_utils import BasicPointCloud
from utils.ranks.ranks import ALONE, Ranks
from utils.sh_utils import C0
from utils.system_utils import UserError


def scene_with(
    path: str | None, options: argparse.Namespace, gaussians: GaussianModel, sharing: Ranks = ALONE
) -> tuple[Scene, Splats | None]:
    """A scene whose points are a file's, and the file's splats in the scene's frame; None for a point cloud.

    The model stays empty. path: None or empty: the points are the dataset's own. options: the model options. Positions
    in the file are those of the world, unless our comment world_offset tells their origin. sharing: as of Scene.
    UserError for a file without splats that are drawn, and as from Scene.
    """
    options = copy.copy(options)
    if not path or is_point_cloud(path):
        options.init_pcd_path = path or getattr(options, "init_pcd_path", "")
        return Scene(options, gaussians, shuffle=False, start=False, sharing=sharing), None
    splats = read_splats(path)
    splats = selected(splats, drawable(splats))
    if not len(splats):
        raise UserError(f"{path} has no Gaussians that are drawn; give another model")
    points = splats.means.astype(np.float64) + splats.world_offset
    colors = np.clip(splats.sh[:, 0] * C0 + 0.5, 0, 1).astype(np.float32)
    # The scene moves them into its frame, as it does any points.
    options.init_pcd_path = BasicPointCloud(points, colors, np.zeros_like(colors))
    scene = Scene(options, gaussians, shuffle=False, start=False, sharing=sharing)
    means = np.ascontiguousarray(scene.info.point_cloud.points, dtype=np.float32)
    return scene, replace(splats, means=means, world_offset=tuple(scene.info.offset.tolist()))


def load_file(options: argparse.Namespace, path: str, pipeline: argparse.Namespace) -> Scene:
    """Scene of the model options with a file's Gaussians, in the place of `load_saved`.

    Its loaded_iter is the name of the file, without endings. `pipeline` gets antialiasing if the file says so.
    UserError for a point cloud, and as from `scene_with`.
    """
    scene, splats = scene_with(path, options, GaussianModel(0))
    if splats is None:
        raise UserError(f"{path} is a point cloud; start a training from it with train.py --init_pcd_path {path}")
    scene.gaussians, scene.loaded_iter = model_of(splats), Path(path).name.split(".")[0]
    scene.gaussians.start_exposures(scene.info.train_cameras)
    pipeline.antialiasing = pipeline.antialiasing or splats.antialiasing
    return scene


def start_from(splats: Splats, scene: Scene, gaussians: GaussianModel) -> None:
    """Give a model these Gaussians as the start of a training: the SH degree is theirs, up to the model's."""
    gaussians.spatial_lr_scale = float(scene.cameras_extent)
    fill_model(gaussians, splats)
    gaussians.start_exposures(scene.info.train_cameras)
    bands = "all SH bands" if splats.sh_degree <= gaussians.max_sh_degree else f"SH bands to {gaussians.max_sh_degree}"
    print(f"Number of Gaussians at initialisation :  {gaussians.total}, with {bands}")
