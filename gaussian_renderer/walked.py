"""The number of Gaussians that each pixel of a view walks through."""

import argparse

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import scene_arguments
from torch import Tensor

from gaussian_renderer import rasterizer_settings
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel


@torch.no_grad()
def gaussians_walked(
    camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace, scaling: float = 1.0
) -> Tensor:
    """(H, W) int32: how far down its tile's list a pixel goes, up to the last Gaussian that is blended into it.

    This is the work of the pixel. Gaussians of the tile that miss the pixel count, those behind the last one do not.
    scaling: factor of all scales.
    """
    background = gaussians.get_xyz.new_zeros(3)
    colors = {"sh_dc": gaussians.get_features_dc, "sh_rest": gaussians.get_features_rest}
    rows = Gaussians(gaussians.get_xyz, **gaussians.raw_geometry(), **colors)
    scene = scene_arguments(rows, rasterizer_settings(camera, gaussians, pipe, background, scaling), True)
    *_, last, _ = OPERATORS.rasterize(rows.means, *scene, background, False, True)
    return last
