"""Trained models for the census: their raw Gaussians and the cameras that look at them."""

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from torch import Tensor

from arguments import ModelParams, PipelineParams, read_cfg_args
from benchmarks.harness.measuring import add_device
from gaussian_renderer import rasterizer_settings
from scene.gaussian_model import GaussianModel
from scene.saved_model import load_saved, read_model
from tests.workloads.splat_scenes import COLUMNS, PARAMETERS, move_camera, settings
from utils.system_utils import UserError

_WIDTH, _HEIGHT, _MADE = 800, 533, 8  # of cameras for a model that has none: px, px, count


class TrainedModel(NamedTuple):
    """A model with its cameras, on one device."""

    label: str
    gaussians: Gaussians  # raw, float32
    cameras: list[GaussianRasterizationSettings]
    made: bool  # the cameras, by `make_cameras_around`

    @property
    def count(self) -> int:
        return len(self.gaussians.means)


def model_parser(doc: str) -> argparse.ArgumentParser:
    """A parser with `models`, whose words `load_trained` reads, --device and --figure."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument(
        "models",
        nargs="+",
        metavar="[LABEL=]MODEL",
        help="folder of train.py (its newest save), a PLY in it, or any PLY, which gets made cameras",
    )
    add_device(parser)
    parser.add_argument("--figure", type=Path, help="image file to write")
    return parser


def load_trained(word: str, device: torch.device | str) -> TrainedModel:
    """The model that a word of the command line names: [LABEL=]PATH. UserError where there is none."""
    label, _, name = word.rpartition("=")
    path = Path(name)
    folder = path if path.is_dir() else path.resolve().parent.parent.parent
    if path.is_dir() or (folder / "cfg_args").is_file():
        iteration = -1 if path.is_dir() else _read_iteration(path)
        return _load_training(label or folder.name, folder, iteration, device)
    model = read_model(path)
    gaussians = _make_raw(model, device)
    return TrainedModel(
        label or path.stem, gaussians, [move_camera(made, device) for made in make_cameras_around(gaussians)], True
    )


def _read_iteration(ply: Path) -> int:
    number = ply.resolve().parent.name.removeprefix("iteration_")
    if not number.isdecimal():
        raise UserError(f"{ply} is in no folder iteration_N of its model; give the model's folder")
    return int(number)


def _load_training(label: str, folder: Path, iteration: int, device: torch.device | str) -> TrainedModel:
    """Load a training's model with all its cameras.

    label: name of the model in tables.
    folder: model folder.
    device: device of Gaussians and cameras.
    """
    parser = argparse.ArgumentParser()
    models, pipelines = ModelParams(parser), PipelineParams(parser)
    options = argparse.Namespace(**vars(parser.parse_args([])) | read_cfg_args(folder) | {"model_path": str(folder)})
    scene, pipe = load_saved(models.extract(options), iteration), pipelines.extract(options)
    views = scene.getTrainCameras() + scene.getTestCameras()
    background = torch.full((3,), float(options.white_background), device=scene.gaussians.get_xyz.device)
    cameras = [rasterizer_settings(view, scene.gaussians, pipe, background) for view in views]
    return TrainedModel(
        label, _make_raw(scene.gaussians, device), [move_camera(camera, device) for camera in cameras], False
    )


def _make_raw(model: GaussianModel, device: torch.device | str) -> Gaussians:
    rows = {name: model.raw(column).detach() for name, column in zip(PARAMETERS, COLUMNS, strict=True)}
    return Gaussians(**{name: values.float().to(device).contiguous() for name, values in rows.items()})


def make_cameras_around(gaussians: Gaussians) -> list[GaussianRasterizationSettings]:
    """Cameras for a model without any: on a circle, looking at the median of the means, 60 degrees wide.

    The circle lies in the plane of the two longest axes of the means. Its radius is twice their median distance from
    the middle.
    """
    means = gaussians.means.double().cpu()
    middle = means.median(0).values
    radius = 2 * (means - middle).norm(dim=1).median()
    near = means[(means - middle).norm(dim=1) < radius] - middle
    first, second, normal = torch.linalg.svd(near, full_matrices=False)[2]
    angles = [2 * math.pi * k / _MADE for k in range(_MADE)]
    degree = round((gaussians.sh_rest.shape[1] + 1) ** 0.5) - 1
    out = [math.cos(angle) * first + math.sin(angle) * second for angle in angles]
    looks = [_look_at(middle + radius * toward, -toward, normal) for toward in out]
    return [settings(_WIDTH, _HEIGHT, view=view, sh_degree=degree, bg=torch.zeros(3).double()) for view in looks]


def _look_at(center: Tensor, forward: Tensor, down: Tensor) -> Tensor:
    """World to view, (4, 4), of a camera at `center`."""
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    view[:3, 3] = -view[:3, :3] @ center
    return view
