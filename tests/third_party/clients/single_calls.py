"""Calls of single functions, each as some script makes it; every call is tried, whatever became of the others.

SCENE MODEL OUT
"""

import io
import json
import math
import os
import sys
import traceback
from argparse import ArgumentParser, Namespace
from contextlib import redirect_stdout
from types import SimpleNamespace

import torch

source, model, out = sys.argv[1:4]
blender = sys.argv[4]
ply = os.path.join(model, "point_cloud", "iteration_300", "point_cloud.ply")
calls = []
PIPE = SimpleNamespace(convert_SHs_python=False, compute_cov3D_python=False, debug=False, antialiasing=False)
RATES = {
    "position_lr_init": 0.00016,
    "position_lr_final": 0.0000016,
    "position_lr_delay_mult": 0.01,
    "position_lr_max_steps": 30_000,
    "feature_lr": 0.0025,
    "opacity_lr": 0.025,
    "scaling_lr": 0.005,
    "rotation_lr": 0.001,
    "percent_dense": 0.01,
}


OPT = SimpleNamespace(**RATES)


def call(function):
    calls.append(function)
    return function


def model_args(**changed):
    ten = {
        "sh_degree": 3,
        "source_path": source,
        "model_path": os.path.join(out, "m"),
        "images": "images",
        "depths": "",
        "resolution": -1,
        "white_background": False,
        "train_test_exp": False,
        "data_device": "cuda",
        "eval": True,
    }
    os.makedirs(ten["model_path"], exist_ok=True)
    return SimpleNamespace(**{**ten, **changed})


def trained(set_up=False):
    from scene import GaussianModel

    gaussians = GaussianModel(3)
    gaussians.load_ply(ply)
    if set_up:
        gaussians.spatial_lr_scale = 1.0
        gaussians.training_setup(OPT)
    return gaussians


def views(**changed):
    from scene import GaussianModel, Scene

    with redirect_stdout(io.StringIO()):
        return Scene(model_args(**changed), GaussianModel(3), shuffle=False)


def draw(camera, gaussians, **options):
    from gaussian_renderer import render

    return render(camera, gaussians, PIPE, torch.zeros(3, device="cuda"), **options)


# Models


@call
def gradient_of_inactive_bands():
    gaussians = trained(True)
    gaussians.active_sh_degree = 0
    draw(views().getTrainCameras()[0], gaussians)["render"].mean().backward()
    assert gaussians._features_rest.grad.abs().max() == 0


# Rendering


@call
def result_of_render():
    gaussians = trained()
    package = draw(views().getTrainCameras()[0], gaussians)
    package["viewspace_points"].retain_grad()
    assert package["depth"].shape == (1, 64, 96) and package["depth"].max() > 0
    assert package["visibility_filter"].shape == (int((package["radii"] > 0).sum()), 1)
    package["render"].sum().backward()
    assert package["viewspace_points"].grad.abs().max() > 0


def settings(camera, **more):
    from diff_gaussian_rasterization import GaussianRasterizationSettings

    return GaussianRasterizationSettings(
        image_height=64, image_width=96, tanfovx=math.tan(camera.FoVx / 2), tanfovy=math.tan(camera.FoVy / 2),
        bg=torch.zeros(3, device="cuda"), scale_modifier=1.0, viewmatrix=camera.world_view_transform,
        projmatrix=camera.full_proj_transform, sh_degree=3, campos=camera.camera_center, prefiltered=False,
        debug=False, **more,
    )  # fmt: skip


@call
def rasterizers_of_three_releases():
    from diff_gaussian_rasterization import GaussianRasterizer, rasterize_gaussians

    camera, pc = views().getTrainCameras()[0], trained()
    points, empty = torch.zeros_like(pc.get_xyz), torch.Tensor([]).cuda()
    shape = {"opacities": pc.get_opacity, "scales": pc.get_scaling, "rotations": pc.get_rotation}
    image, radii = GaussianRasterizer(settings(camera))(pc.get_xyz, points, shs=pc.get_features, **shape)
    second, _, depth = GaussianRasterizer(settings(camera, antialiasing=False))(
        pc.get_xyz, points, shs=pc.get_features, **shape
    )
    third = GaussianRasterizer(settings(camera, antialiasing=False))(
        means3D=pc.get_xyz, means2D=points, dc=pc.get_features_dc, shs=pc.get_features_rest, **shape
    )
    fourth = rasterize_gaussians(
        pc.get_xyz, points, pc.get_features, empty, *shape.values(), empty, settings(camera, antialiasing=False)
    )
    assert len(third) == len(fourth) == 3 and depth.shape == (1, 64, 96)
    assert all(torch.equal(image, other) for other in (second, third[0], fourth[0]))


@call
def compiled_module():
    from diff_gaussian_rasterization import _C

    camera, pc = views().getTrainCameras()[0], trained()
    visible = _C.mark_visible(pc.get_xyz, camera.world_view_transform, camera.full_proj_transform)
    assert visible.dtype == torch.bool and visible.any()


# Small functions


@call
def distances():
    from simple_knn._C import distCUDA2

    points = torch.rand(20, 6, device="cuda", dtype=torch.float64)[:, ::2].float()
    found = distCUDA2(points)
    wanted = torch.cdist(points.double(), points.double()).pow(2).sort(dim=1).values[:, 1:4].mean(dim=1)
    assert torch.allclose(found.double(), wanted, rtol=1e-4)


@call
def options_of_ones_own():
    from arguments import GroupParams, ModelParams, ParamGroup

    class Extra(ParamGroup):
        def __init__(self, parser, sentinel=False):
            self.depth = 3
            self.rate = 0.5
            self._name = "none"
            self.fast = False
            super().__init__(parser, "Extra Parameters", sentinel)

    class Wider(ModelParams):
        def __init__(self, parser, sentinel=False):
            self.feature_size = 16
            super().__init__(parser, sentinel)

    parser = ArgumentParser()
    extra, wider = Extra(parser), Wider(parser)
    args = parser.parse_args(["-n", "x", "--rate", "0.25", "--fast", "--feature_size", "4", "-s", "."])
    group = extra.extract(args)
    assert (group.depth, group.rate, group.name, group.fast) == (3, 0.25, "x", True)
    assert isinstance(group, GroupParams) and wider.extract(args).feature_size == 4
    free = GroupParams()
    free.anything = 1
    empty = ArgumentParser()
    late = Extra(empty, sentinel=True)
    assert empty.parse_args([]).rate is None and late.extract(Namespace(rate=1.0)).rate == 1.0


@call
def names_of_scripts():
    from gaussian_renderer import GaussianModel, network_gui
    from train import prepare_output_and_logger, training, training_report
    from utils.general_utils import get_expon_lr_func, inverse_sigmoid, safe_state
    from utils.image_utils import mse, psnr
    from utils.system_utils import mkdir_p, searchForMaxIteration

    assert all(map(callable, (prepare_output_and_logger, training, training_report, get_expon_lr_func, mkdir_p)))
    assert all(map(callable, (inverse_sigmoid, safe_state, mse, psnr, searchForMaxIteration, GaussianModel)))
    assert network_gui.conn is None
    assert all(callable(getattr(network_gui, name)) for name in ("init", "try_connect", "receive", "send"))


result = {}
for function in calls:
    try:
        function()
        result[function.__name__] = "ok"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        result[function.__name__] = (
            f"{type(error).__name__}: {error} ({os.path.basename(place.filename)}:{place.lineno}: {place.line})"
        )
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
