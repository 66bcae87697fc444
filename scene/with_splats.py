"""Conversion between models and splats; splats of a file with a scene, as the start of a training or to be shown."""

import argparse
import copy
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from groundwork.files.json_files import ENLARGEMENT, OFFSET, read_model_json
from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import attributes
from scene.gaussians.morton import sort_scattered
from scene.saved_model import read_model
from scene.scene import Scene
from scene.splats.ply import columns_of
from scene.splats.reading import is_point_cloud, read_splats
from scene.splats.splats import Splats, base_colors, drawable, selected
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError


@torch.no_grad()
def splats_of(gaussians: GaussianModel, antialiasing: bool = False) -> Splats:
    """Make splats of a model, on the CPU. Values of other activations become logits and logs, as in files."""
    shapes = gaussians.log_scales(), gaussians.get_rotation, gaussians.opacity_logits()[:, 0]
    values = (gaussians.get_xyz, *shapes, gaussians.get_features)
    means, scales, rotations, logits, sh = (x.detach().float().cpu().contiguous().numpy() for x in values)
    return Splats(means, scales, rotations, logits, sh, antialiasing, gaussians.world_offset, gaussians.enlargement)


def splats_in(path: str | os.PathLike) -> Splats:
    """The Gaussians of a file, as `read_splats`, or of a checkpoint of train.py, ours or the reference's."""
    if Path(path).suffix.lower() != ".pth" or not os.path.isfile(path):
        return read_splats(path)
    gaussians = read_model(Path(path))
    place(gaussians, Path(path).parent)
    return splats_of(gaussians)


def place(gaussians: GaussianModel, model_path: str | os.PathLike) -> None:
    """Give a model the place and the enlargement that its folder records."""
    record = read_model_json(model_path)
    gaussians.world_offset = tuple(record.get(OFFSET, (0.0, 0.0, 0.0)))
    gaussians.enlargement = record.get(ENLARGEMENT, 1.0)


def model_of(splats: Splats, sh_degree: int | None = None) -> GaussianModel:
    """Make a model, on the device that computes, with all SH bands active. sh_degree: the model's, None: the splats'.

    Bands that the splats lack are zero; those above sh_degree are left out.
    """
    degree = splats.sh_degree if sh_degree is None else sh_degree
    gaussians = GaussianModel(degree)
    gaussians.world_offset, gaussians.enlargement = splats.world_offset, splats.enlargement
    fill_model(gaussians, splats)
    return gaussians


def fill_model(gaussians: GaussianModel, splats: Splats) -> None:
    """Give a model these Gaussians, with the bands that it has. The splats' bands become active.

    Attributes that splats do not have get the values of new Gaussians.
    """
    columns = columns_of(splats)
    bands = (gaussians.max_sh_degree + 1) ** 2 - 1
    rest = columns["f_rest"][:, :bands]
    columns["f_dc"] = columns["f_dc"].contiguous()
    columns["f_rest"] = torch.nn.functional.pad(rest, (0, 0, 0, bands - rest.shape[1])).contiguous()
    for name, attribute in attributes(gaussians.max_sh_degree).items():
        if name not in columns:
            columns[name] = torch.full((len(splats), *attribute.shape), attribute.start)
    gaussians.take_whole(columns)
    gaussians.active_sh_degree = min(gaussians.max_sh_degree, splats.sh_degree)


def read_start(path: str | None, options: argparse.Namespace) -> tuple[argparse.Namespace, Splats | None]:
    """Return model options whose init_pcd_path is a file's points, and its splats that are drawn, in the world.

    The splats are None for a point cloud, whose path the options get, and without a file. UserError for a file without
    splats that are drawn.
    """
    if not path:
        return options, None
    options = copy.copy(options)
    if is_point_cloud(path):
        options.init_pcd_path = path
        return options, None
    splats = splats_in(path)
    splats = selected(splats, drawable(splats))
    if not len(splats):
        raise UserError(f"{path} has no Gaussians that are drawn; give another model")
    points = splats.means.astype(np.float64) + splats.world_offset
    colors = np.clip(base_colors(splats), 0, 1)
    # The scene moves them into its frame, as it does any points.
    options.init_pcd_path = BasicPointCloud(points, colors, np.zeros_like(colors))
    return options, splats


def scene_with(
    path: str | None, options: argparse.Namespace, gaussians: GaussianModel, **of_scene: Any
) -> tuple[Scene, Splats | None]:
    """Make a scene whose points are a file's, and return its splats in the scene's frame, None for a point cloud.

    Without a file, the points are the dataset's.

    The model stays empty. Positions in the file are the world's, unless our comment world_offset has their origin.
    UserError for a file without splats that are drawn, and as from Scene.

    options: the model options.
    of_scene: further arguments of Scene.
    """
    options, splats = read_start(path, options)
    scene = Scene(options, gaussians, shuffle=False, start=False, **of_scene)
    if splats is None:
        return scene, None
    if splats.enlargement != 1:  # as the file says, which is that of its training
        gaussians.enlargement = splats.enlargement
    means = np.ascontiguousarray(scene.info.point_cloud.points, dtype=np.float32)
    frame = {"world_offset": gaussians.world_offset, "enlargement": gaussians.enlargement}
    return scene, replace(splats, means=means, **frame)


def load_file(options: argparse.Namespace, path: str, pipeline: argparse.Namespace) -> Scene:
    """Scene of the model options with a file's Gaussians, in the place of `load_saved`.

    Its loaded_iter is the name of the file, without endings. `pipeline` gets antialiasing if the file says so.
    UserError for a point cloud, and as from `scene_with`.
    """
    scene, splats = scene_with(path, options, GaussianModel(0))
    if splats is None:
        raise UserError(f"{path} is a point cloud; start a training from it with train.py --init_pcd_path {path}")
    scene.gaussians, scene.loaded_iter = model_of(splats), Path(path).name.split(".")[0]
    sort_scattered(scene.gaussians)
    scene.gaussians.start_exposures(scene.info.train_cameras)
    pipeline.antialiasing = pipeline.antialiasing or splats.antialiasing
    return scene


def start_from(splats: Splats, scene: Scene, gaussians: GaussianModel) -> None:
    """Give a model these Gaussians as the start of a training: the SH degree is theirs, up to the model's."""
    gaussians.spatial_lr_scale = float(scene.cameras_extent)
    fill_model(gaussians, splats)
    gaussians.start_exposures(scene.info.train_cameras)
    bands = "all SH bands" if splats.sh_degree <= gaussians.max_sh_degree else f"SH bands to {gaussians.max_sh_degree}"
    print(f"Number of Gaussians at initialisation :  {gaussians.gaussian_count}, with {bands}")
