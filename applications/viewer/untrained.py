"""A scene before any training, as a viewer shows it: its cameras with their photos, and its points as small spheres."""

import argparse

import numpy as np
import torch

from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from scene.splats.splats import Splats
from scene.with_splats import model_of
from utils.sh_utils import RGB2SH
from utils.system_utils import UserError

_SIZE = 1e-3  # standard deviation of a point, by the extent of the cameras
_LOGIT = 6.0  # of its opacity


def load_untrained(options: argparse.Namespace) -> Scene:
    """Load the scene of the model options, with its points as Gaussians. UserError for a scene without points."""
    scene = Scene(options, GaussianModel(0), shuffle=False, start=False)
    points, offset, enlargement = scene.info.point_cloud, scene.gaussians.world_offset, scene.gaussians.enlargement
    if not len(points.points):
        raise UserError(f"{options.source_path} has no points to show; train it first, and give its model with -m")
    scene.gaussians = model_of(_make_spheres(points.points, points.colors, _SIZE * scene.cameras_extent))
    scene.gaussians.world_offset, scene.gaussians.enlargement = offset, enlargement
    scene.model_path = options.source_path  # the name of the page, and where it writes paths and crops
    return scene


def _make_spheres(points: np.ndarray, colors: np.ndarray, size: float) -> Splats:
    """Nearly opaque Gaussians at points (N, 3) with colors (N, 3) in [0, 1] and a standard deviation, all alike."""
    count = len(points)
    sh = RGB2SH(torch.from_numpy(np.asarray(colors, np.float32)))[:, None].numpy()
    turns = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    sizes = np.full((count, 3), np.log(max(size, 1e-6)), np.float32)
    return Splats(np.asarray(points, np.float32), sizes, turns, np.full(count, _LOGIT, np.float32), sh)
