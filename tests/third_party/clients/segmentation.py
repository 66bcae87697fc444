"""A segmentation of a trained model: labels in 3D, virtual cameras of its own, a PLY of one part, all by plyfile.

SCENE MODEL OUT
"""

import json
import os
import sys
from argparse import ArgumentParser, Namespace

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from arguments import ModelParams, PipelineParams
from gaussian_renderer import render
from scene import Scene
from scene.cameras import MiniCam
from scene.gaussian_model import GaussianModel
from utils.graphics_utils import getProjectionMatrix, getWorld2View

source, model, out = sys.argv[1:4]
with open(os.path.join(model, "cfg_args")) as file:
    stored = eval(file.read(), {"Namespace": Namespace})
parser = ArgumentParser()
dataset = ModelParams(parser, sentinel=True).extract(stored)
pipe = PipelineParams(parser).extract(Namespace())
dataset.model_path = model
dataset.part_name = "a name of ours on the extracted group"
pipe.convert_SHs_python = pipe.compute_cov3D_python = pipe.debug = pipe.antialiasing = False
gaussians = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, gaussians, load_iteration=-1, shuffle=False)
background = torch.zeros(3, device="cuda")


def virtual_camera(view):
    """A camera at the pose of a view, with matrices in float32 throughout."""
    world_view = torch.tensor(getWorld2View(view.R, view.T)).transpose(0, 1).cuda()
    projection = getProjectionMatrix(znear=0.01, zfar=100.0, fovX=view.FoVx, fovY=view.FoVy).transpose(0, 1).cuda()
    full = (world_view.unsqueeze(0).bmm(projection.unsqueeze(0))).squeeze(0)
    size = view.image_width, view.image_height
    return MiniCam(*size, view.FoVy, view.FoVx, 0.01, 100.0, world_view, full)


def write_part(pc, mask, path):
    """The raw values of some Gaussians as a PLY in the layout of the model's own."""
    names = pc.construct_list_of_attributes()
    xyz = pc._xyz.detach().cpu().numpy()
    dc = pc._features_dc.detach().transpose(1, 2).flatten(start_dim=1).contiguous().cpu().numpy()
    rest = pc._features_rest.detach().transpose(1, 2).flatten(start_dim=1).contiguous().cpu().numpy()
    columns = [xyz, np.zeros_like(xyz), dc, rest]
    columns += [values.detach().cpu().numpy() for values in (pc._opacity, pc._scaling, pc._rotation)]
    table = np.concatenate(columns, axis=1)[mask]
    elements = np.empty(len(table), dtype=[(name, "f4") for name in names])
    elements[:] = list(map(tuple, table))
    os.makedirs(os.path.dirname(path), exist_ok=True)
    PlyData([PlyElement.describe(elements, "vertex")]).write(path)
    return names


ply = os.path.join(scene.model_path, "point_cloud", f"iteration_{scene.loaded_iter}", "point_cloud.ply")
vertices = PlyData.read(ply)["vertex"]
labels = np.asarray(vertices["x"]) > np.median(vertices["x"])
result = {"count": len(vertices), "labelled": int(labels.sum()), "uid": [], "virtual": []}

with torch.no_grad():
    for view in scene.getTestCameras():
        seen = render(view, gaussians, pipe, background)["render"]
        virtual = render(virtual_camera(view), gaussians, pipe, background)["render"]
        result["virtual"].append((seen - virtual).abs().max().item())
        result["uid"].append(view.uid)
    path = os.path.join(out, "part", "point_cloud.ply")
    result["names"] = write_part(gaussians, labels, path)
    part = GaussianModel(dataset.sh_degree)
    part.load_ply(path)
    mask = torch.from_numpy(labels).cuda()
    fields = ("_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_rotation")
    result["part_difference"] = max((getattr(part, f) - getattr(gaussians, f)[mask]).abs().max().item() for f in fields)
    # Hide the other part instead: the same image, since Gaussians without opacity draw nothing.
    gaussians._opacity.data[~mask] = -30.0
    view = scene.getTestCameras()[0]
    hidden, cut = (render(view, pc, pipe, background)["render"] for pc in (gaussians, part))
    result["hidden_difference"] = (hidden - cut).abs().max().item()
    result["part_seen"] = cut.max().item()
    # The label as a colour.
    colors = torch.ones((len(vertices), 3), device="cuda")
    result["label_image"] = list(render(view, gaussians, pipe, background, override_color=colors)["render"].shape)

with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
