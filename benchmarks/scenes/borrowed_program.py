"""A training loop typed out from the reference's release, as other people's code has it, and the time it takes.

`benchmarks.scenes.borrowed_loop` runs it in several checkouts, as the text of a program, so that it imports their code.
It uses only names that 51e305e has, too. Its last line on stderr is JSON.
"""

import copy
import json
import pickle
import random
import statistics
import sys
import time
from argparse import ArgumentParser

import torch

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.general_utils import safe_state
from utils.loss_utils import l1_loss, ssim

WARM = 50  # iterations that are not timed
COPIES = 20


def train(dataset, opt, pipe, device) -> tuple[Scene, float]:
    """Train as the release's loop does. Returns the scene and the milliseconds of an iteration."""
    gaussians = GaussianModel(dataset.sh_degree)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    background = torch.zeros(3, device=device)
    stack = None
    for iteration in range(1, opt.iterations + 1):
        if iteration == WARM + 1:
            start = time.perf_counter()
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not stack:
            stack = scene.getTrainCameras().copy()
        camera = stack.pop(random.randint(0, len(stack) - 1))
        package = render(camera, gaussians, pipe, background)
        image, points = package["render"], package["viewspace_points"]
        visible, radii = package["visibility_filter"], package["radii"]
        if getattr(camera, "alpha_mask", None) is not None:
            image = image * camera.alpha_mask.to(device)
        photo = camera.original_image.to(device)
        l1 = l1_loss(image, photo)
        loss = (1.0 - opt.lambda_dssim) * l1 + opt.lambda_dssim * (1.0 - ssim(image, photo))
        loss.backward()
        with torch.no_grad():
            loss.item()  # the progress bar's
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[visible] = torch.max(gaussians.max_radii2D[visible], radii[visible])
                gaussians.add_densification_stats(points, visible)
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size = 20 if iteration > opt.opacity_reset_interval else None
                    gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005, scene.cameras_extent, size)
                if iteration % opt.opacity_reset_interval == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                if exposures := getattr(gaussians, "exposure_optimizer", None):
                    exposures.step()
                    exposures.zero_grad(set_to_none=True)
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    if device.type == "cuda":
        torch.cuda.synchronize()
    return scene, 1e3 * (time.perf_counter() - start) / (opt.iterations - WARM)


def main() -> None:
    """The arguments are scene, model folder and iterations."""
    scene_folder, model, iterations = sys.argv[1:]
    parser = ArgumentParser()
    groups = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    args = parser.parse_args(["-s", scene_folder, "-m", model, "--eval", "--iterations", iterations])
    safe_state(True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    scene, milliseconds = train(*(group.extract(args) for group in groups), device)
    camera, copies = scene.getTrainCameras()[0], []
    for _ in range(COPIES):
        start = time.perf_counter()
        copy.deepcopy(camera)
        copies.append(1e3 * (time.perf_counter() - start))
    result = {"loop": milliseconds, "deepcopy": statistics.median(copies), "pickle": len(pickle.dumps(camera)) / 1e3}
    print(json.dumps(result), file=sys.stderr)
