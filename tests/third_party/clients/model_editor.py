"""An editor of trained models: changes raw tensors, cuts Gaussians and SH bands, saves, and fine-tunes a loaded PLY.

SCENE MODEL OUT
"""

import glob
import json
import os
import sys
from argparse import ArgumentParser

import torch
from torch import nn

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.loss_utils import l1_loss
from utils.sh_utils import RGB2SH

source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
args = parser.parse_args(["-s", source, "-m", os.path.join(out, "scene"), "--eval"])
dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
os.makedirs(dataset.model_path, exist_ok=True)
ply = glob.glob(os.path.join(model, "point_cloud", "iteration_*", "point_cloud.ply"))[0]
background = torch.zeros(3, device="cuda")
result = {}

# A fresh scene, then the trained PLY over its Gaussians.
gaussians = GaussianModel(3)
scene = Scene(dataset, gaussians, shuffle=False)
gaussians.load_ply(ply)
camera = scene.getTrainCameras()[0]
count = gaussians.get_xyz.shape[0]
result["count"] = count


@torch.no_grad()
def image_of(pc):
    return render(camera, pc, pipe, background)["render"]


# In place.
before = image_of(gaussians)
with torch.no_grad():
    gaussians._features_dc.copy_(RGB2SH(torch.tensor([1.0, 0.0, 0.0], device="cuda")).expand(count, 1, 3))
    gaussians._features_rest.data[:] = 0
    gaussians._scaling.data += 0.1
    gaussians._opacity[: count // 2] += 0.5
red = image_of(gaussians)
result["green_left"] = red[1:].max().item()
result["red_seen"] = red[0].max().item()
gaussians.save_ply(os.path.join(out, "red", "point_cloud.ply"))

# By replacement: plain tensors and parameters, all cut by one mask.
gaussians = GaussianModel(3)
gaussians.load_ply(ply)
keep = gaussians.get_opacity.squeeze() > gaussians.get_opacity.median()
reference = gaussians.get_xyz[keep].clone()
gaussians._xyz = gaussians._xyz[keep]
gaussians._features_dc = nn.Parameter(gaussians._features_dc[keep].detach())
gaussians._features_rest = gaussians._features_rest[keep].detach()
gaussians._opacity = gaussians._opacity[keep]
gaussians._scaling = gaussians._scaling[keep]
gaussians._rotation = gaussians._rotation[keep]
result["kept"] = int(keep.sum())
result["radii"] = list(render(camera, gaussians, pipe, background)["radii"].shape)
result["sizes"] = [gaussians.get_covariance().shape[0], gaussians.get_features.shape[0]]

# Fewer SH bands, by a slice.
gaussians._features_rest = gaussians._features_rest[:, :3, :]
gaussians.max_sh_degree = gaussians.active_sh_degree = 1
small = image_of(gaussians)
path = os.path.join(out, "small", "point_cloud.ply")
gaussians.save_ply(path)
again = GaussianModel(1)
again.load_ply(path)
result["small_bands"] = list(again.get_features.shape)
result["small_difference"] = (image_of(again) - small).abs().max().item()
result["small_xyz"] = (again.get_xyz - reference).abs().max().item()


def fine_tune(pc, steps=20):
    """Train all views a little; the mean loss of the first and of the last five steps."""
    pc.training_setup(opt)
    losses = []
    for step in range(steps):
        view = scene.getTrainCameras()[step % 5]
        loss = l1_loss(render(view, pc, pipe, background)["render"], view.original_image.cuda())
        loss.backward()
        pc.optimizer.step()
        pc.optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
    return sum(losses[:5]) / 5, sum(losses[-5:]) / 5


# The loaded PLY of the scene, then a PLY without any scene, then the cut one with its sliced bands.
whole = scene.gaussians
whole.load_ply(ply)
result["tuned_scene"] = fine_tune(whole)
lone = GaussianModel(3)
lone.load_ply(ply)
result["tuned_lone"] = fine_tune(lone)
gaussians._xyz = nn.Parameter(gaussians._xyz.detach())
gaussians._features_rest = nn.Parameter(gaussians._features_rest.detach())
for name in ("_opacity", "_scaling", "_rotation"):
    setattr(gaussians, name, nn.Parameter(getattr(gaussians, name).detach()))
result["tuned_small"] = fine_tune(gaussians)
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
