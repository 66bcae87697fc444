"""A model's view as arguments of the rasterizer's operators."""

import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.ops import scene_arguments

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel


@torch.no_grad()
def view_arguments(camera: Camera, model: GaussianModel) -> tuple:
    """Return the arguments that describe Gaussians and camera, as a training with default options has them."""
    colors = {"sh_dc": model.get_features_dc, "sh_rest": model.get_features_rest}
    gaussians = Gaussians(model.get_xyz, **model.raw_geometry(), **colors)
    settings = GaussianRasterizationSettings(
        image_height=camera.image_height,
        image_width=camera.image_width,
        tanfovx=math.tan(camera.FoVx / 2),
        tanfovy=math.tan(camera.FoVy / 2),
        bg=model.get_xyz.new_zeros(3),
        scale_modifier=1.0,
        viewmatrix=camera.world_view_transform,
        projmatrix=camera.full_proj_transform,
        sh_degree=model.active_sh_degree,
        campos=camera.camera_center,
        prefiltered=False,
        debug=False,
        antialiasing=False,
    )
    return scene_arguments(gaussians, settings, raw=True)
