"""Trained models as workloads. Seeded splats in a frustum are fog, in which three quarters of the instances are hidden;
of a trained model few are, and its rows lie in Morton order."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

import torch

from arguments import ModelParams, PipelineParams, read_cfg_args
from benchmarks.workloads.splat_scenes import COLUMNS, PARAMETERS, SplatScene
from gaussian_renderer import rasterizer_settings, render
from scene.saved_model import load_saved


@torch.no_grad()
def trained(folder: Path) -> SplatScene:
    """Return the model that train.py has left in a folder, with the view that sees the median number of Gaussians.

    UserError where the folder has no model, or its scene is missing.
    """
    parser = ArgumentParser()
    models, pipelines = ModelParams(parser), PipelineParams(parser)
    options = Namespace(**vars(parser.parse_args([])) | read_cfg_args(folder) | {"model_path": str(folder)})
    scene, pipe = load_saved(models.extract(options), -1), pipelines.extract(options)
    gaussians, background = scene.gaussians, torch.zeros(3, device=scene.gaussians.get_xyz.device)
    views = sorted(scene.getTrainCameras(), key=lambda view: view.image_name)
    seen = [int((render(view, gaussians, pipe, background)["radii"] > 0).sum()) for view in views]
    view = views[sorted(range(len(views)), key=seen.__getitem__)[len(views) // 2]]
    rows = {name: gaussians.raw(column).detach().clone() for name, column in zip(PARAMETERS, COLUMNS, strict=True)}
    return SplatScene(rows, view.image_width, view.image_height, rasterizer_settings(view, gaussians, pipe, background))
