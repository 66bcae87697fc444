"""A renderer of videos: copies of a view that get a new pose, and cameras made by the October 2024 keywords.

SCENE MODEL OUT
"""

import copy
import json
import os
import pickle
import sys
from argparse import ArgumentParser

import numpy as np
import torch
from PIL import Image

from arguments import ModelParams, PipelineParams, get_combined_args
from gaussian_renderer import render
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.general_utils import safe_state
from utils.graphics_utils import getProjectionMatrix, getWorld2View2

source, model, out = sys.argv[1:4]
sys.argv = ["camera_paths.py", "-m", model]
parser = ArgumentParser()
lp, pp = ModelParams(parser, sentinel=True), PipelineParams(parser)
parser.add_argument("--iteration", default=-1, type=int)
args = get_combined_args(parser)
safe_state(True)
dataset, pipe = lp.extract(args), pp.extract(args)
gaussians = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, gaussians, load_iteration=args.iteration, shuffle=False)
views = scene.getTrainCameras()
background = torch.zeros(3, device="cuda")


def moved(template, R, t):
    """A copy of a view at another pose."""
    view = copy.deepcopy(template)
    matrix = getWorld2View2(R, t, view.trans, view.scale)
    view.world_view_transform = torch.tensor(matrix).transpose(0, 1).cuda()
    projection = getProjectionMatrix(znear=view.znear, zfar=view.zfar, fovX=view.FoVx, fovY=view.FoVy)
    view.projection_matrix = projection.transpose(0, 1).cuda()
    view.full_proj_transform = (
        view.world_view_transform.unsqueeze(0).bmm(view.projection_matrix.unsqueeze(0))
    ).squeeze(0)
    view.camera_center = view.world_view_transform.inverse()[3, :3]
    return view


def image_of(view):
    with torch.no_grad():
        return render(view, gaussians, pipe, background)["render"]


for view in views:
    _ = view.original_image  # as after a training
result = {
    "matrix": str(getWorld2View2(views[0].R, views[0].T).dtype),
    "projection": str(getProjectionMatrix(0.01, 100.0, 0.8, 0.6).dtype),
    "trans": np.asarray(views[0].trans).tolist(),
    "scale": float(views[0].scale),
    "pickled": len(pickle.dumps(copy.deepcopy(views[0]))),
}

# Poses of the next view on a copy of the first: the same image as the next view's.
target = views[1]
step = moved(views[0], target.R, target.T)
result["at_next"] = (image_of(step) - image_of(target)).abs().max().item()
result["first_kept"] = (views[0].world_view_transform - step.world_view_transform).abs().max().item()
# By translate and scale, which act on the camera's centre: twice as far from the origin, and back by the scale.
center = target.camera_center.cpu().numpy().astype(np.float64)
far = getWorld2View2(target.R, target.T, center, 0.5)
result["scaled"] = float(np.abs(far - getWorld2View2(target.R, target.T)).max())

os.makedirs(os.path.join(out, "frames"))
for index, part in enumerate(np.linspace(0, 1, 4)):
    between = moved(views[0], views[0].R, (1 - part) * views[0].T + part * views[1].T)
    array = (image_of(between).permute(1, 2, 0).cpu().numpy() * 255 + 0.5).astype(np.uint8)
    Image.fromarray(array).save(os.path.join(out, "frames", f"{index:05d}.png"))

# Cameras made from nothing but numbers and a picture.
blank = Image.new("RGB", (target.image_width, target.image_height))
made = Camera(
    resolution=blank.size,
    colmap_id=1,
    R=target.R,
    T=target.T,
    FoVx=target.FoVx,
    FoVy=target.FoVy,
    depth_params=None,
    image=blank,
    invdepthmap=None,
    image_name="virtual",
    uid=7,
)
result["made"] = (image_of(made) - image_of(target)).abs().max().item()
result["made_fields"] = [made.uid, made.colmap_id, made.image_name, made.original_image.max().item()]
result["made_mask"] = made.alpha_mask.min().item()
result["made_depth"] = [made.invdepthmap is None, bool(made.depth_reliable)]

# All of the arguments: alpha in the picture, an inverse depth map with its scale, one half of a test view.
picture = Image.new("RGBA", (40, 20), (255, 51, 0, 102))
depth = np.full((20, 40), 0.5, dtype=np.float32)
full = Camera((20, 10), 1, target.R, target.T, target.FoVx, target.FoVy,
              {"scale": 2.0, "offset": 0.25, "med_scale": 2.0}, picture, depth, "half", 0, np.array([0.0, 0.0, 0.0]),
              1.0, "cuda", True, False, True)  # fmt: skip
result["full_image"] = [list(full.original_image.shape), full.original_image[:, 0, 0].tolist()]
result["full_alpha"] = [full.alpha_mask[..., :10].min().item(), full.alpha_mask[..., 10:].max().item()]
result["full_depth"] = [list(full.invdepthmap.shape), full.invdepthmap.max().item(), bool(full.depth_reliable)]
wild = Camera((20, 10), 1, target.R, target.T, target.FoVx, target.FoVy,
              {"scale": 20.0, "offset": 0.25, "med_scale": 2.0}, picture, depth, "wild", 0)  # fmt: skip
result["wild_depth"] = [bool(wild.depth_reliable), wild.depth_mask.max().item()]
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
