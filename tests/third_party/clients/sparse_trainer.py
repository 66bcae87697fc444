"""A trainer that uses the accelerated rasterizer by itself: dc and shs apart, SparseGaussianAdam on groups of its own.

SCENE MODEL OUT
"""

import json
import math
import os
import sys
from argparse import ArgumentParser

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam
from torch import nn

from arguments import ModelParams
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss

RATE = 0.01


def rasterizer_for(camera, antialiasing=False):
    settings = GaussianRasterizationSettings(
        int(camera.image_height), int(camera.image_width), math.tan(camera.FoVx * 0.5), math.tan(camera.FoVy * 0.5),
        torch.zeros(3, device="cuda"), 1.0, camera.world_view_transform, camera.full_proj_transform, 3,
        camera.camera_center, False, False, antialiasing,
    )  # fmt: skip
    return GaussianRasterizer(raster_settings=settings)


source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp = ModelParams(parser)
dataset = lp.extract(parser.parse_args(["-s", source, "-m", model, "--eval"]))
gaussians = GaussianModel(3)
scene = Scene(dataset, gaussians, load_iteration=-1, shuffle=False)
xyz = nn.Parameter(gaussians.get_xyz.detach().clone())
dc = nn.Parameter(gaussians.get_features_dc.detach().clone())
rest = nn.Parameter(gaussians.get_features_rest.detach().clone())
opacity, scales, rotations = (
    t.detach() for t in (gaussians.get_opacity, gaussians.get_scaling, gaussians.get_rotation)
)
groups = [
    {"params": [xyz], "lr": 1e-4, "name": "xyz"},
    {"params": [dc], "lr": RATE, "name": "f_dc"},
    {"params": [rest], "lr": RATE / 20, "name": "f_rest"},
]
optimizer = SparseGaussianAdam(groups, lr=0.0, eps=1e-15)


def draw(camera, **colors):
    points = torch.zeros_like(xyz, requires_grad=True)
    image, radii, depth = rasterizer_for(camera)(
        means3D=xyz, means2D=points, opacities=opacity, scales=scales, rotations=rotations, cov3D_precomp=None, **colors
    )
    return image.clamp(0, 1), radii, depth


with torch.no_grad():
    camera = scene.getTrainCameras()[0]
    apart, together = draw(camera, dc=dc, shs=rest), draw(camera, shs=torch.cat((dc, rest), dim=1))
result = {
    "apart": (apart[0] - together[0]).abs().max().item(),
    "depth": list(apart[2].shape),
    "is_optimizer": isinstance(optimizer, torch.optim.Optimizer),
}

losses = []
for step in range(20):
    camera = scene.getTrainCameras()[step % 4]
    image, radii, _ = draw(camera, dc=dc, shs=rest)
    loss = l1_loss(image, camera.original_image.cuda())
    loss.backward()
    losses.append(loss.item())
    visible = radii > 0
    if step == 0:
        visible[: len(visible) // 2] = False  # pretend that the view sees less
        before, gradient = dc.detach().clone(), dc.grad.clone()
        moments = 0.1 * gradient, 0.001 * gradient**2
        wanted = before - RATE * moments[0] / (moments[1].sqrt() + 1e-15)
    optimizer.step(visible, radii.shape[0])
    if step == 0:
        result["unseen_moved"] = (dc - before)[~visible].abs().max().item()
        result["seen_wrong"] = (dc - wanted)[visible].abs().max().item()
        result["seen_moved"] = (dc - before)[visible].abs().max().item()
    optimizer.zero_grad(set_to_none=True)
result["losses"] = losses
result["state"] = sorted(optimizer.state[dc])
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
