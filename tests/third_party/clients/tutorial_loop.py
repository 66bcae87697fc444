"""The training loop of the October 2024 release, typed out: SCENE MODEL OUT [options of train.py]."""

import json
import os
import sys
from argparse import ArgumentParser
from random import randint

import torch
from fused_ssim import fused_ssim
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.general_utils import get_expon_lr_func, safe_state
from utils.image_utils import psnr
from utils.loss_utils import l1_loss


@torch.no_grad()
def evaluate(cameras, gaussians, pipe, background, dataset):
    scores = []
    for camera in cameras:
        image = render(camera, gaussians, pipe, background, 1.0, True, None, dataset.train_test_exp)
        image = torch.clamp(image["render"], 0.0, 1.0)
        target = torch.clamp(camera.original_image.to("cuda"), 0.0, 1.0)
        if dataset.train_test_exp:
            image, target = image[..., image.shape[-1] // 2 :], target[..., target.shape[-1] // 2 :]
        scores.append(psnr(image, target).mean().double().item())
    return sum(scores) / len(scores)


def training(dataset, opt, pipe, args):
    first = 0
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if args.start_checkpoint:
        (model_params, first) = torch.load(args.start_checkpoint)
        gaussians.restore(model_params, opt)
    background = torch.tensor([1, 1, 1] if dataset.white_background else [0, 0, 0], dtype=torch.float32, device="cuda")
    depth_weight = get_expon_lr_func(opt.depth_l1_weight_init, opt.depth_l1_weight_final, max_steps=opt.iterations)
    stack, losses, depth_losses = None, [], []

    for iteration in tqdm(range(first + 1, opt.iterations + 1)):
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not stack:
            stack = scene.getTrainCameras().copy()
        camera = stack.pop(randint(0, len(stack) - 1))
        bg = torch.rand((3), device="cuda") if opt.random_background else background
        package = render(camera, gaussians, pipe, bg, use_trained_exp=dataset.train_test_exp, separate_sh=True)
        image, points = package["render"], package["viewspace_points"]
        visible, radii = package["visibility_filter"], package["radii"]
        if camera.alpha_mask is not None:
            alpha_mask = camera.alpha_mask.cuda()
            image *= alpha_mask
        target = camera.original_image.cuda()
        l1 = l1_loss(image, target)
        similarity = fused_ssim(image.unsqueeze(0), target.unsqueeze(0))
        loss = (1.0 - opt.lambda_dssim) * l1 + opt.lambda_dssim * (1.0 - similarity)
        if depth_weight(iteration) > 0 and camera.depth_reliable:
            depth, wanted, counted = package["depth"], camera.invdepthmap.cuda(), camera.depth_mask.cuda()
            depth_loss = torch.abs((depth - wanted) * counted).mean()
            loss += depth_weight(iteration) * depth_loss
            depth_losses.append(depth_loss.item())
        loss.backward()

        with torch.no_grad():
            losses.append(l1.item())
            if iteration in args.save_iterations:
                scene.save(iteration)
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[visible] = torch.max(gaussians.max_radii2D[visible], radii[visible])
                gaussians.add_densification_stats(points, visible)
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size_threshold = 20 if iteration > opt.opacity_reset_interval else None
                    gaussians.densify_and_prune(
                        opt.densify_grad_threshold, 0.005, scene.cameras_extent, size_threshold, radii
                    )
                late = dataset.white_background and iteration == opt.densify_from_iter
                if iteration % opt.opacity_reset_interval == 0 or late:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.exposure_optimizer.step()
                gaussians.exposure_optimizer.zero_grad(set_to_none=True)
                if opt.optimizer_type == "sparse_adam":
                    gaussians.optimizer.step(radii > 0, radii.shape[0])
                else:
                    gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration in args.checkpoint_iterations:
                torch.save((gaussians.capture(), iteration), scene.model_path + "/chkpnt" + str(iteration) + ".pth")

    exposures = gaussians._exposure
    return {
        "losses": losses,
        "depth_losses": depth_losses,
        "psnr": evaluate(scene.getTestCameras(), gaussians, pipe, background, dataset),
        "count": gaussians.get_xyz.shape[0],
        "exposures": list(exposures.shape),
        "exposure_moved": (exposures - torch.eye(3, 4, device="cuda")).abs().max().item(),
    }


if __name__ == "__main__":
    parser = ArgumentParser(description="Training script parameters")
    lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    parser.add_argument("--save_iterations", nargs="+", type=int, default=[7_000, 30_000])
    parser.add_argument("--checkpoint_iterations", nargs="+", type=int, default=[])
    parser.add_argument("--start_checkpoint", type=str, default=None)
    out = sys.argv[3]
    args = parser.parse_args(["-s", sys.argv[1], "-m", out, *sys.argv[4:]])
    args.save_iterations.append(args.iterations)
    os.makedirs(out, exist_ok=True)
    safe_state(False)
    result = training(lp.extract(args), op.extract(args), pp.extract(args), args)
    with open(os.path.join(out, "result.json"), "w") as file:
        json.dump(result, file)
