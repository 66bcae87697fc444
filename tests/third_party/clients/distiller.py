"""A distiller: a student with fewer SH bands learns from a teacher, both restored from one checkpoint.

SCENE MODEL OUT
"""

import copy
import json
import os
import sys
from argparse import ArgumentParser

import torch
from torch import nn

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss

STEPS, GAMMA, DEGREE = 20, 0.9, 1

source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
args = parser.parse_args(["-s", source, "-m", os.path.join(out, "student"), "--eval"])
dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
os.makedirs(dataset.model_path, exist_ok=True)
checkpoint = os.path.join(model, "chkpnt300.pth")
(teacher_params, _), (model_params, first) = torch.load(checkpoint), torch.load(checkpoint)
teacher, student = GaussianModel(3), GaussianModel(3)
scene = Scene(dataset, student)
teacher.restore(teacher_params, opt)
student.restore(model_params, opt)
teacher.active_sh_degree = student.active_sh_degree = 3
with torch.no_grad():
    teacher._features_rest.uniform_(-0.02, 0.02)
    teacher._features_dc += 0.1  # something to learn

bands = (DEGREE + 1) ** 2 - 1
student.max_sh_degree = student.active_sh_degree = DEGREE
student._features_rest = nn.Parameter(teacher._features_rest[:, :bands].detach().requires_grad_(True))  # a view
student.training_setup(opt)
for frozen in (student._xyz, student._rotation):
    frozen.requires_grad = False
scheduler = torch.optim.lr_scheduler.ExponentialLR(student.optimizer, gamma=GAMMA)
start = {group["name"]: group["lr"] for group in student.optimizer.param_groups}
before = {name: getattr(student, name).detach().clone() for name in ("_xyz", "_rotation", "_features_rest", "_scaling")}
background = torch.zeros(3, device="cuda")
losses = []
for step in range(STEPS):
    camera = copy.deepcopy(scene.getTrainCameras()[step % 4])
    image = render(camera, student, pipe, background)["render"]
    with torch.no_grad():
        wanted = render(camera, teacher, pipe, background)["render"].detach()
    loss = l1_loss(image, wanted)
    loss.backward()
    student.optimizer.step()
    student.optimizer.zero_grad(set_to_none=True)
    scheduler.step()
    losses.append(loss.item())
ply = os.path.join(out, "student", "point_cloud", "iteration_1", "point_cloud.ply")
student.save_ply(ply)
again = GaussianModel(DEGREE)
again.load_ply(ply)
result = {
    "first": first,
    "losses": losses,
    "moved": {name: (getattr(student, name) - values).abs().max().item() for name, values in before.items()},
    "rates": {group["name"]: group["lr"] / start[group["name"]] for group in student.optimizer.param_groups},
    "bands": list(again.get_features.shape),
    "count": teacher.get_xyz.shape[0],
    "saved": (again.get_features - student.get_features).abs().max().item(),
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
