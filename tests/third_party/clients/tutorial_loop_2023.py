"""A training loop as the 2023 release has it, with option classes of its own that know only that release's options.

SCENE MODEL OUT [options]
"""

import json
import os
import sys
from argparse import ArgumentParser
from random import randint

import torch

from arguments import ParamGroup
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loss_utils import l1_loss, ssim


class ModelOptions(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.sh_degree, self._resolution, self.data_device = 3, -1, "cuda"
        self._source_path, self._model_path, self._images = "", "", "images"
        self._white_background = self.eval = False
        super().__init__(parser, "Loading Parameters", sentinel)

    def extract(self, args):
        options = super().extract(args)
        options.source_path = os.path.abspath(options.source_path)
        return options


class PipelineOptions(ParamGroup):
    def __init__(self, parser):
        self.convert_SHs_python = self.compute_cov3D_python = self.debug = False
        super().__init__(parser, "Pipeline Parameters")


class OptimizationOptions(ParamGroup):
    def __init__(self, parser):
        self.iterations = self.position_lr_max_steps = 30_000
        self.position_lr_init, self.position_lr_final, self.position_lr_delay_mult = 0.00016, 0.0000016, 0.01
        self.feature_lr, self.opacity_lr, self.scaling_lr, self.rotation_lr = 0.0025, 0.05, 0.005, 0.001
        self.percent_dense, self.lambda_dssim, self.densify_grad_threshold = 0.01, 0.2, 0.0002
        self.densification_interval, self.opacity_reset_interval = 100, 3000
        self.densify_from_iter, self.densify_until_iter = 500, 15_000
        super().__init__(parser, "Optimization Parameters")


def training(dataset, opt, pipe):
    gaussians = GaussianModel(dataset.sh_degree)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    background = torch.tensor([0, 0, 0], dtype=torch.float32, device="cuda")
    stack, losses = None, []
    for iteration in range(1, opt.iterations + 1):
        if network_gui.conn is None:
            network_gui.try_connect()
        gaussians.update_learning_rate(iteration)
        if not stack:
            stack = scene.getTrainCameras().copy()
        camera = stack.pop(randint(0, len(stack) - 1))
        package = render(camera, gaussians, pipe, background)
        image, points, seen, radii = (package[k] for k in ("render", "viewspace_points", "visibility_filter", "radii"))
        target = camera.original_image.cuda()
        l1 = l1_loss(image, target)
        loss = (1.0 - opt.lambda_dssim) * l1 + opt.lambda_dssim * (1.0 - ssim(image, target))
        loss.backward()
        losses.append(l1.item())
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[seen] = torch.max(gaussians.max_radii2D[seen], radii[seen])
                gaussians.add_densification_stats(points, seen)
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size = 20 if iteration > opt.opacity_reset_interval else None
                    gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005, scene.cameras_extent, size)
                if iteration % opt.opacity_reset_interval == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    scene.save(opt.iterations)
    with torch.no_grad():
        scores = [
            psnr(render(camera, gaussians, pipe, background)["render"], camera.original_image.cuda()).mean().item()
            for camera in scene.getTestCameras()
        ]
    return {"losses": losses, "psnr": sum(scores) / len(scores), "count": gaussians.get_xyz.shape[0]}


if __name__ == "__main__":
    parser = ArgumentParser()
    lp, op, pp = ModelOptions(parser), OptimizationOptions(parser), PipelineOptions(parser)
    parser.add_argument("--port", type=int, default=6009)
    out = sys.argv[3]
    args = parser.parse_args(["-s", sys.argv[1], "-m", out, *sys.argv[4:]])
    os.makedirs(out, exist_ok=True)
    safe_state(False)
    network_gui.init("127.0.0.1", args.port)
    result = training(lp.extract(args), op.extract(args), pp.extract(args))
    with open(os.path.join(out, "result.json"), "w") as file:
        json.dump(result, file)
