"""Calls of single functions, each as some script makes it; every call is tried, whatever became of the others.

SCENE MODEL OUT
"""

import copy
import io
import json
import math
import os
import sys
import traceback
from argparse import ArgumentParser, Namespace
from contextlib import redirect_stdout
from types import SimpleNamespace

import numpy as np
import torch
from PIL import Image
from torch import nn

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
EXPOSURE = {
    "iterations": 100,
    "exposure_lr_init": 0.01,
    "exposure_lr_final": 0.001,
    "exposure_lr_delay_steps": 0,
    "exposure_lr_delay_mult": 0.0,
}
OPT = SimpleNamespace(**RATES, **EXPOSURE)


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


def step(gaussians, camera):
    draw(camera, gaussians)["render"].mean().backward()
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad(set_to_none=True)


# Datasets


@call
def colmap_scene_by_keywords():
    from scene.dataset_readers import readColmapSceneInfo

    info = readColmapSceneInfo(path=source, images=None, depths="", eval=True, train_test_exp=False, llffhold=4)
    assert len(info.test_cameras) == 5 and info.is_nerf_synthetic is False
    info = readColmapSceneInfo(source, "images", "", True, False)
    assert abs(info.nerf_normalization["radius"] - views().cameras_extent) < 1e-4


@call
def colmap_scene_of_2023():
    from scene.dataset_readers import readColmapSceneInfo, sceneLoadTypeCallbacks

    assert len(readColmapSceneInfo(source, "images", True).test_cameras) == 3
    assert len(sceneLoadTypeCallbacks["Colmap"](source, None, False).test_cameras) == 0


@call
def blender_scene():
    from scene.dataset_readers import readCamerasFromTransforms, sceneLoadTypeCallbacks

    info = sceneLoadTypeCallbacks["Blender"](blender, True, "", True)
    assert (len(info.train_cameras), len(info.test_cameras), info.is_nerf_synthetic) == (4, 2, True)
    assert len(info.point_cloud.points) == 100_000
    frames = readCamerasFromTransforms(blender, "transforms_test.json", "", True, True, ".png")
    assert [frame.is_test for frame in frames] == [True, True] and frames[0].image_name == "r_0"


@call
def blender_scene_of_2023():
    from scene.dataset_readers import sceneLoadTypeCallbacks

    assert len(sceneLoadTypeCallbacks["Blender"](blender, False, False).train_cameras) == 6


@call
def colmap_cameras():
    from scene.colmap_loader import read_extrinsics_binary, read_intrinsics_binary
    from scene.dataset_readers import readColmapCameras

    folder = os.path.join(source, "sparse", "0")
    images = read_extrinsics_binary(os.path.join(folder, "images.bin"))
    names = [images[key].name for key in images]
    infos = readColmapCameras(
        cam_extrinsics=images, cam_intrinsics=read_intrinsics_binary(os.path.join(folder, "cameras.bin")),
        depths_params=None, images_folder=os.path.join(source, "images"), depths_folder="",
        test_cam_names_list=names[:2],
    )  # fmt: skip
    assert len(infos) == 17 and sum(info.is_test for info in infos) == 2


@call
def camera_list():
    from scene.dataset_readers import readColmapSceneInfo
    from utils.camera_utils import cameraList_from_camInfos

    info = readColmapSceneInfo(source, "images", "", True, False)
    cameras = cameraList_from_camInfos(info.test_cameras, 1.0, model_args(), info.is_nerf_synthetic, True)
    assert [camera.uid for camera in cameras] == [0, 1, 2] and cameras[0].original_image.shape == (3, 64, 96)


@call
def load_one_camera():
    from scene.dataset_readers import readColmapSceneInfo
    from utils.camera_utils import Camera, loadCam

    info = readColmapSceneInfo(source, "images", "", True, False)
    camera = loadCam(model_args(), 5, info.train_cameras[0], 2.0, False, False)
    assert isinstance(camera, Camera) and (camera.uid, camera.image_width, camera.image_height) == (5, 48, 32)


@call
def json_of_a_plain_record():
    from utils.camera_utils import camera_to_JSON

    record = SimpleNamespace(
        R=np.eye(3), T=np.array([1.0, 2, 3]), FovX=1.0, FovY=1.0, width=10, height=20, image_name="a"
    )
    entry = camera_to_JSON(4, record)
    assert entry["position"] == [-1, -2, -3] and abs(entry["fx"] - 5 / math.tan(0.5)) < 1e-9
    assert list(entry) == ["id", "img_name", "width", "height", "position", "rotation", "fy", "fx"]


@call
def clouds_from_disk():
    from scene.dataset_readers import fetchPly, focal2fov, storePly

    path = os.path.join(out, "cloud.ply")
    storePly(path, np.array([[0.0, 1, 2], [3, 4, 5]]), np.array([[0, 128, 255], [1, 2, 3]]))
    cloud = fetchPly(path)
    assert cloud.points.tolist() == [[0, 1, 2], [3, 4, 5]] and np.allclose(cloud.colors[0] * 255, [0, 128, 255])
    assert cloud.normals.shape == (2, 3) and abs(focal2fov(1, 2) - math.pi / 2) < 1e-9


# Models


@call
def start_from_plain_records():
    from scene import GaussianModel
    from utils.graphics_utils import BasicPointCloud

    cloud = BasicPointCloud(points=np.random.rand(9, 3), colors=np.random.rand(9, 3), normals=np.zeros((9, 3)))
    gaussians = GaussianModel(2)
    gaussians.create_from_pcd(cloud, [SimpleNamespace(image_name="a"), SimpleNamespace(image_name="b")], 1.5)
    assert gaussians.spatial_lr_scale == 1.5 and gaussians._exposure.shape == (2, 3, 4)
    assert gaussians.exposure_mapping == {"a": 0, "b": 1} and gaussians.pretrained_exposures is None
    assert torch.equal(gaussians.get_exposure_from_name("b"), torch.eye(3, 4, device="cuda"))
    gaussians.create_from_pcd(cloud, 2.0)  # 2023
    assert gaussians.spatial_lr_scale == 2.0 and len(gaussians.get_xyz) == 9
    gaussians.training_setup(SimpleNamespace(**RATES))  # 2023
    assert [group["name"] for group in gaussians.optimizer.param_groups][:3] == ["xyz", "f_dc", "f_rest"]


@call
def load_with_exposure_option():
    from scene import GaussianModel

    gaussians = GaussianModel(3)
    gaussians.load_ply(ply, use_train_test_exp=False)
    assert gaussians.active_sh_degree == 3
    other = copy.deepcopy(gaussians)
    other._xyz.data += 1
    assert (other.get_xyz - gaussians.get_xyz).min() > 0.9


@call
def activations():
    gaussians = trained()
    pairs = (
        ("opacity", gaussians._opacity, gaussians.inverse_opacity_activation),
        ("scaling", gaussians._scaling, gaussians.scaling_inverse_activation),
    )
    for name, raw, inverse in pairs:
        value = getattr(gaussians, f"{name}_activation")(raw)
        assert torch.allclose(value, getattr(gaussians, f"get_{name}")) and torch.allclose(
            inverse(value), raw, atol=1e-2
        )
    assert torch.allclose(gaussians.rotation_activation(gaussians._rotation), gaussians.get_rotation)
    packed = gaussians.covariance_activation(gaussians.get_scaling, 1.0, gaussians._rotation)
    assert torch.allclose(packed, gaussians.get_covariance())


@call
def rows_through_the_optimizer():
    gaussians = trained(True)
    step(gaussians, views().getTrainCameras()[0])
    count = len(gaussians.get_xyz)
    names = {
        "xyz": "_xyz",
        "f_dc": "_features_dc",
        "f_rest": "_features_rest",
        "opacity": "_opacity",
        "scaling": "_scaling",
        "rotation": "_rotation",
    }
    longer = gaussians.cat_tensors_to_optimizer({name: getattr(gaussians, field)[:5] for name, field in names.items()})
    assert list(longer) == list(names) and len(longer["xyz"]) == count + 5
    assert gaussians.optimizer.state[longer["xyz"]]["exp_avg"][count:].abs().max() == 0
    keep = torch.arange(count + 5, device="cuda") < count
    shorter = gaussians._prune_optimizer(keep)
    assert len(shorter["rotation"]) == count and torch.equal(shorter["xyz"], gaussians._xyz)
    fresh = gaussians.replace_tensor_to_optimizer(torch.zeros_like(gaussians._opacity), "opacity")
    assert list(fresh) == ["opacity"] and fresh["opacity"].requires_grad


@call
def another_group_of_rows():
    gaussians = trained(True)
    label = nn.Parameter(torch.rand(len(gaussians.get_xyz), 4, device="cuda"))
    gaussians.optimizer.add_param_group({"params": [label], "lr": 0.01, "name": "label"})
    mask = torch.arange(len(label), device="cuda") % 2 == 0
    gaussians.prune_points(mask)
    assert torch.equal(gaussians.optimizer.param_groups[-1]["params"][0], label[~mask])


@call
def a_network_in_the_optimizer():
    gaussians = trained(True)
    network = nn.Linear(3, 3).cuda()
    gaussians.optimizer.add_param_group({"params": list(network.parameters()), "lr": 0.1, "name": "mlp"})
    before = network.weight.detach().clone()
    image = draw(views().getTrainCameras()[0], gaussians)["render"]
    network(image.permute(1, 2, 0)).mean().backward()
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad()
    assert not torch.equal(before, network.weight)


@call
def an_adam_of_ones_own():
    gaussians = trained(True)
    groups = [{key: group[key] for key in ("params", "lr", "name")} for group in gaussians.optimizer.param_groups]
    gaussians.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    step(gaussians, views().getTrainCameras()[0])
    gaussians.reset_opacity()
    gaussians.active_sh_degree = 1
    gaussians.oneupSHdegree()
    count = len(gaussians.get_xyz)
    gaussians.prune_points(torch.arange(count, device="cuda") < 10)
    assert len(gaussians.optimizer.state[gaussians._xyz]["exp_avg"]) == count - 10 and gaussians.active_sh_degree == 2
    assert gaussians.get_opacity.max() <= 0.0101


@call
def rows_appended_in_both_forms():
    gaussians = trained(True)
    gaussians.tmp_radii = torch.zeros(len(gaussians.get_xyz), device="cuda")
    new = [
        tensor[:3].detach()
        for tensor in (
            gaussians._xyz,
            gaussians._features_dc,
            gaussians._features_rest,
            gaussians._opacity,
            gaussians._scaling,
            gaussians._rotation,
        )
    ]
    count = len(gaussians.get_xyz)
    gaussians.densification_postfix(*new, torch.ones(3, device="cuda"))
    assert len(gaussians.tmp_radii) == count + 3 and gaussians.tmp_radii[-3:].sum() == 3
    gaussians.tmp_radii = None
    gaussians.densification_postfix(*new)  # 2023
    assert len(gaussians.get_xyz) == count + 6 and gaussians.denom.shape == (count + 6, 1)


@call
def gradient_of_inactive_bands():
    gaussians = trained(True)
    gaussians.active_sh_degree = 0
    draw(views().getTrainCameras()[0], gaussians)["render"].mean().backward()
    assert gaussians._features_rest.grad.abs().max() == 0


@call
def captured_tensors_want_gradients():
    gaussians = trained(True)
    captured = gaussians.capture()
    assert len(captured) == 12 and all(tensor.requires_grad for tensor in captured[1:7])


@call
def exposure_optimizer():
    scene = views()
    gaussians = scene.gaussians
    gaussians.training_setup(OPT)
    camera = scene.getTrainCameras()[0]
    draw(camera, gaussians, use_trained_exp=True)["render"].mean().backward()
    row = gaussians.exposure_mapping[camera.image_name]
    assert gaussians._exposure.grad[row].abs().max() > 0
    gaussians.exposure_optimizer.step()
    gaussians.exposure_optimizer.zero_grad(set_to_none=True)
    assert not torch.equal(gaussians._exposure[row], torch.eye(3, 4, device="cuda"))
    gaussians.pretrained_exposures = {camera.image_name: torch.zeros(3, 4, device="cuda")}
    assert draw(camera, gaussians, use_trained_exp=True)["render"].max() == 0


# Cameras


@call
def camera_attributes():
    camera = views().getTrainCameras()[0]
    assert isinstance(camera, nn.Module) and camera.alpha_mask.min() == 1 and camera.alpha_mask.shape == (1, 64, 96)
    assert str(camera.data_device).startswith("cuda") or torch.device(camera.data_device).type == "cpu"
    assert np.asarray(camera.trans).tolist() == [0, 0, 0] and camera.scale == 1.0
    assert camera.invdepthmap is None and not camera.depth_reliable
    camera.original_image = torch.zeros(3, 64, 96)
    assert camera.original_image.max() == 0
    camera.features = 1


@call
def scene_dictionaries():
    scene = views()
    assert list(scene.train_cameras) == [1.0] and scene.train_cameras[1.0] == scene.getTrainCameras()
    scene.test_cameras = {1.0: scene.getTrainCameras()[:2]}
    scene.train_cameras[1.0] = scene.train_cameras[1.0][:3]
    assert len(scene.getTestCameras()) == 2 and len(scene.getTrainCameras()) == 3


@call
def mini_camera_in_float64():
    from scene.cameras import MiniCam

    camera = views().getTrainCameras()[0]
    matrices = camera.world_view_transform.double(), camera.full_proj_transform.double()
    mini = MiniCam(96, 64, camera.FoVy, camera.FoVx, 0.01, 100.0, *matrices)
    images = [draw(view, trained())["render"] for view in (mini, camera)]
    assert (images[0] - images[1]).abs().max() < 1e-4


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
def images_and_matrices():
    from utils.general_utils import PILtoTorch, build_scaling_rotation, strip_lowerdiag, strip_symmetric
    from utils.graphics_utils import geom_transform_points, getProjectionMatrix, getWorld2View, getWorld2View2

    image = PILtoTorch(Image.new("RGBA", (8, 6), (255, 0, 51, 102)), (4, 3))
    assert image.shape == (4, 3, 4) and torch.allclose(image[:, 0, 0], torch.tensor([1, 0, 0.2, 0.4]), atol=0.005)
    assert PILtoTorch(Image.new("L", (8, 6), 255), (8, 6)).shape == (1, 6, 8)
    factor = build_scaling_rotation(torch.rand(5, 3, device="cuda"), torch.rand(5, 4, device="cuda"))
    covariance = factor @ factor.transpose(1, 2)
    assert torch.equal(strip_lowerdiag(covariance), strip_symmetric(covariance))
    R, t = np.diag([1.0, -1, -1]), np.array([1.0, 2, 3])
    assert getWorld2View(R, t).dtype == getWorld2View2(R, t, np.zeros(3), 1.0).dtype == np.float32
    assert np.allclose(getWorld2View(R, t), getWorld2View2(R, t))
    projection = getProjectionMatrix(znear=0.01, zfar=100.0, fovX=1.0, fovY=0.8)
    assert projection.dtype == torch.float32 and projection[3, 2] == 1
    moved = geom_transform_points(torch.rand(7, 3), torch.eye(4) + torch.tensor([[0.0] * 4] * 3 + [[1.0, 0, 0, 0]]))
    assert moved.shape == (7, 3) and moved[:, 0].min() > 0.99


@call
def similarity_by_its_parts():
    import fused_ssim as package
    from fused_ssim import FusedSSIMMap, allowed_padding, fused_ssim

    from utils.loss_utils import _ssim, create_window, gaussian, ssim

    a, b = torch.rand(1, 3, 30, 40, device="cuda"), torch.rand(1, 3, 30, 40, device="cuda")
    window = create_window(11, 3)
    assert window.shape == (3, 1, 11, 11) and abs(gaussian(11, 1.5).sum().item() - 1) < 1e-6
    whole = ssim(a, b)
    assert torch.allclose(_ssim(a, b, window.cuda(), 11, 3), whole, atol=1e-5)
    assert torch.allclose(ssim(a, b, size_average=False), whole[None], atol=1e-5)
    assert set(allowed_padding) == {"same", "valid"} and package.FusedSSIMMap is FusedSSIMMap
    part = FusedSSIMMap.apply(0.01**2, 0.03**2, a, b, "same", True)
    assert part.shape == a.shape and torch.allclose(part.mean(), fused_ssim(a, b), atol=1e-5)
    assert torch.allclose(fused_ssim(a, b, train=False), whole, atol=1e-5)
    assert fused_ssim(a.permute(0, 1, 3, 2), b.permute(0, 1, 3, 2), padding="valid").ndim == 0


@call
def harmonics():
    from utils import sh_utils

    sizes = [np.size(getattr(sh_utils, f"C{degree}")) for degree in range(5)]
    assert sizes == [1, 1, 5, 7, 9] and abs(sh_utils.C1 - 0.4886025) < 1e-6
    assert torch.allclose(sh_utils.SH2RGB(sh_utils.RGB2SH(torch.tensor([0.3]))), torch.tensor([0.3]))


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
