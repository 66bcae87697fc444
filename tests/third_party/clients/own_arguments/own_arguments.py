"""A stylist: its own package `arguments` is found first; it changes the colours of a loaded PLY towards a palette.

SCENE MODEL OUT
"""

import json
import os
import sys

import torch

import arguments
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loss_utils import l1_loss

source, model, out = sys.argv[1:4]
safe_state(True)
dataset = arguments.model_options(source, os.path.join(out, "styled"))
opt, pipe = arguments.optimization_options(), arguments.pipeline_options()
os.makedirs(dataset.model_path)
gaussians = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, gaussians)
gaussians.load_ply(os.path.join(model, "point_cloud", "iteration_300", "point_cloud.ply"))
gaussians.training_setup(opt)
background = torch.tensor([0.0, 0.0, 0.0], dtype=torch.float32, device="cuda")
palette = torch.tensor([0.9, 0.2, 0.1], device="cuda")
for camera in scene.getTrainCameras():
    with torch.no_grad():
        camera.content = render(camera, gaussians, pipe, background)["render"]
before = {name: getattr(gaussians, name).detach().clone() for name in ("_xyz", "_features_dc", "_opacity")}
stack, losses = [], []
for iteration in range(1, opt.iterations + 1):
    gaussians.update_learning_rate(iteration)
    stack = stack or scene.getTrainCameras().copy()
    camera = stack.pop()
    image = render(camera, gaussians, pipe, background, use_trained_exp=dataset.train_test_exp)["render"]
    style = (image.mean(dim=(1, 2)) - palette).abs().mean()
    loss = opt.style_weight * style + 0.1 * l1_loss(image, camera.content)
    loss.backward()
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad(set_to_none=True)
    losses.append(style.item())
scene.save(opt.iterations)
torch.save((gaussians.capture(), opt.iterations), os.path.join(scene.model_path, "chkpnt20.pth"))
again = GaussianModel(dataset.sh_degree)
again.load_ply(os.path.join(scene.model_path, "point_cloud", f"iteration_{opt.iterations}", "point_cloud.ply"))
with torch.no_grad():
    camera = scene.getTestCameras()[0]
    images = [render(camera, pc, pipe, background)["render"] for pc in (gaussians, again)]
result = {
    "arguments": os.path.abspath(arguments.__file__),
    "viewer": network_gui.conn is None,
    "losses": losses,
    "moved": {name: (getattr(gaussians, name) - values).abs().max().item() for name, values in before.items()},
    "saved_psnr": min(psnr(*images).mean().item(), 200.0),
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
