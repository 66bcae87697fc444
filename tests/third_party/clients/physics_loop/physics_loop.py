"""A physics simulation that draws its particles by the 2023 rasterizer: 12 settings, two results.

SCENE MODEL OUT
"""

import json
import math
import os
import sys

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

from gaussian_renderer import GaussianModel, render
from scene.cameras import Camera
from utils.graphics_utils import focal2fov
from utils.motion_utils import turn
from utils.sh_utils import eval_sh
from utils.system_utils import searchForMaxIteration


class PipelineParamsNoparse:
    def __init__(self):
        self.convert_SHs_python = False
        self.compute_cov3D_python = False
        self.debug = False


def load_checkpoint(model_path, sh_degree=3):
    folder = os.path.join(model_path, "point_cloud")
    gaussians = GaussianModel(sh_degree)
    iteration = searchForMaxIteration(folder)
    gaussians.load_ply(os.path.join(folder, f"iteration_{iteration}", "point_cloud.ply"))
    return gaussians


def camera_of(entry, **changed):
    """A camera of cameras.json, in the 2023 form with a tensor as image."""
    R = np.array(entry["rotation"])
    w, h = entry["width"], entry["height"]
    T = -R.T @ np.array(entry["position"])
    given = dict(
        colmap_id=0,
        R=R,
        T=T,
        FoVx=focal2fov(entry["fx"], w),
        FoVy=focal2fov(entry["fy"], h),
        image=torch.zeros((3, h, w)),
        gt_alpha_mask=None,
        image_name=entry["img_name"],
        uid=0,
    )
    return Camera(**{**given, **changed})


def initialize_rasterizer(camera, sh_degree, background):
    settings = GaussianRasterizationSettings(
        image_height=int(camera.image_height),
        image_width=int(camera.image_width),
        tanfovx=math.tan(camera.FoVx * 0.5),
        tanfovy=math.tan(camera.FoVy * 0.5),
        bg=background,
        scale_modifier=1.0,
        viewmatrix=camera.world_view_transform,
        projmatrix=camera.full_proj_transform,
        sh_degree=sh_degree,
        campos=camera.camera_center,
        prefiltered=False,
        debug=False,
    )
    return GaussianRasterizer(raster_settings=settings)


def convert_SH(shs, camera, position, turned=None):
    view = shs.transpose(1, 2).view(-1, 3, 16)
    direction = position - camera.camera_center.repeat(len(position), 1)
    if turned is not None:
        direction = direction @ turned
    return torch.clamp_min(eval_sh(3, view, direction / direction.norm(dim=1, keepdim=True)) + 0.5, 0.0)


@torch.no_grad()
def main(model, out):
    gaussians, pipe = load_checkpoint(model), PipelineParamsNoparse()
    background = torch.tensor([0.2, 0.3, 0.4], device="cuda")
    with open(os.path.join(model, "cameras.json")) as file:
        entry = json.load(file)[0]
    camera = camera_of(entry)
    rasterize = initialize_rasterizer(camera, gaussians.active_sh_degree, background)
    position, covariance, shs = gaussians.get_xyz, gaussians.get_covariance(), gaussians.get_features
    part = gaussians.get_opacity[:, 0] > 0.02  # the particles that are simulated
    points = torch.zeros_like(position, requires_grad=True) + 0
    images = []
    for frame in range(3):
        moved, shape, turned = turn(position, covariance, 0.2 * frame)
        rendering, radii = rasterize(
            means3D=moved[part],
            means2D=points[part],
            shs=None,
            colors_precomp=convert_SH(shs, camera, moved, turned)[part],
            opacities=gaussians.get_opacity[part],
            scales=None,
            rotations=None,
            cov3D_precomp=shape[part],
        )
        images.append(rendering)
    whole, _ = rasterize(
        position,
        points,
        gaussians.get_opacity,
        colors_precomp=convert_SH(shs, camera, position),
        cov3D_precomp=covariance,
    )
    usual = render(camera, gaussians, pipe, background)["render"]
    masked = camera_of(entry, image=torch.ones(3, 64, 96) * 1.5, gt_alpha_mask=torch.full((1, 64, 96), 0.25))
    return {
        "whole_difference": (whole.clamp(0, 1) - usual).abs().max().item(),
        "frames_differ": [(image - images[0]).abs().mean().item() for image in images],
        "radii": list(radii.shape),
        "part": int(part.sum()),
        "masked": [masked.original_image.min().item(), masked.original_image.max().item()],
    }


if __name__ == "__main__":
    result = main(sys.argv[2], sys.argv[3])
    with open(os.path.join(sys.argv[3], "result.json"), "w") as file:
        json.dump(result, file)
