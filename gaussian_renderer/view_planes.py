"""Inverse depth and alpha of a view, as the rasterizer blends them, and how many Gaussians that takes."""

import argparse

import torch
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.scene import draw, scene_arguments
from torch import Tensor

from gaussian_renderer import rasterizer_settings, render
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel

PLANES = ("depth", "alpha")


@torch.no_grad()
def view_planes(
    camera: Camera | MiniCam, gaussians: GaussianModel, pipe: argparse.Namespace, scaling: float = 1.0
) -> dict[str, Tensor]:
    """`depth` and `alpha` of a view, (1, H, W) float32 each, by the weights w_i of the image's Gaussians.

    depth: inverse depth, the sum of w_i / z_i, per world unit; z_i is the depth of a mean. Where alpha is below 1 it is
    that much smaller, so divide it by alpha to get that of what is there. alpha: the sum of w_i, in [0, 1].
    scaling: factor of all scales.
    """
    white = gaussians.get_xyz.new_ones(len(gaussians), 3)
    black = gaussians.get_xyz.new_zeros(3)
    options = {"override_color": white, "want_depth": True, "want_visibility": False}
    drawn = render(camera, gaussians, pipe, black, scaling, **options)
    return {"depth": drawn["depth"], "alpha": drawn["render"][:1]}


@torch.no_grad()
def blend_depth(
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
    return draw(scene, background).last
