"""A pruner: restores a checkpoint, removes the least important Gaussians in two rounds, trains on, and saves.

SCENE MODEL OUT
"""

import json
import os
import sys
from argparse import ArgumentParser
from random import randint, seed

import torch

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss, ssim

source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
args = parser.parse_args(["-s", source, "-m", os.path.join(out, "pruned"), "--eval", "--iterations", "340"])
dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
os.makedirs(dataset.model_path)
gaussians = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, gaussians)
gaussians.training_setup(opt)
(model_params, first) = torch.load(os.path.join(model, "chkpnt300.pth"))
gaussians.restore(model_params, opt)
background = torch.zeros(3, device="cuda")


def importance():
    """Summed length of the positions' gradients over all views."""
    total = torch.zeros(gaussians.get_xyz.shape[0], device="cuda")
    for camera in scene.getTrainCameras():
        package = render(camera, gaussians, pipe, background)
        l1_loss(package["render"], camera.original_image.cuda()).backward()
        total += gaussians._xyz.grad.norm(dim=1) * gaussians.get_opacity.detach().squeeze()
        gaussians.optimizer.zero_grad(set_to_none=True)
    return total


seed(0)  # the views drawn below
losses, counts, stack = [], [gaussians.get_xyz.shape[0]], None
for iteration in range(first + 1, opt.iterations + 1):
    gaussians.update_learning_rate(iteration)
    if iteration % 100 == 0:
        gaussians.oneupSHdegree()
    if iteration in (first + 1, first + 20):
        scores = importance()
        threshold = torch.sort(scores).values[int(0.3 * len(scores))]
        mask = scores < threshold
        state = gaussians.optimizer.state[gaussians._xyz]["exp_avg"][~mask].clone()
        kept = gaussians._xyz.detach()[~mask].clone()
        gaussians.prune_points(mask)
        counts.append(gaussians.get_xyz.shape[0])
        moments = gaussians.optimizer.state[gaussians._xyz]["exp_avg"]
        same = torch.equal(kept, gaussians._xyz.detach()) and torch.equal(state, moments)
        sizes = {t.shape[0] for t in (gaussians.max_radii2D, gaussians.denom, gaussians.xyz_gradient_accum)}
        assert same and sizes == {counts[-1]}
    stack = stack or scene.getTrainCameras().copy()
    camera = stack.pop(randint(0, len(stack) - 1))
    package = render(camera, gaussians, pipe, background)
    target = camera.original_image.cuda()
    loss = 0.8 * l1_loss(package["render"], target) + 0.2 * (1.0 - ssim(package["render"], target))
    loss.backward()
    losses.append(loss.item())
    with torch.no_grad():
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad(set_to_none=True)
scene.save(opt.iterations)
torch.save((gaussians.capture(), opt.iterations), os.path.join(scene.model_path, f"chkpnt{opt.iterations}.pth"))
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump({"losses": losses, "counts": counts, "first": first}, file)
