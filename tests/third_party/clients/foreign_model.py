"""Models of one's own in the project's renderer: a class with the getters alone, and a subclass with softplus scales.

SCENE MODEL OUT
"""

import json
import math
import os
import sys
from argparse import ArgumentParser

import torch
import torch.nn.functional as F
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from torch import nn

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss


class DecodedGaussians(nn.Module):
    """Gaussians whose values a network decodes; only what a renderer reads."""

    def __init__(self, other):
        super().__init__()
        self.active_sh_degree = self.max_sh_degree = other.max_sh_degree
        self.anchors = nn.Parameter(other.get_xyz.detach().clone())
        self.colors = nn.Parameter(other.get_features.detach().clone())
        self.sizes = nn.Parameter(other.get_scaling.detach().clone())
        self.weights = nn.Parameter(other.get_opacity.detach().clone())
        self.register_buffer("turns", other.get_rotation.detach().clone())

    get_xyz = property(lambda self: self.anchors)
    get_features = property(lambda self: self.colors)
    get_scaling = property(lambda self: self.sizes)
    get_opacity = property(lambda self: self.weights.clamp(0, 1))
    get_rotation = property(lambda self: self.turns)


class SoftplusModel(GaussianModel):
    """Scales by softplus instead of exp."""

    def setup_functions(self):
        super().setup_functions()
        self.scaling_activation = F.softplus
        self.scaling_inverse_activation = lambda x: x + torch.log(-torch.expm1(-x))


def rasterized(camera, pc, background):
    """What the rasterizer makes of the activated values."""
    settings = GaussianRasterizationSettings(
        int(camera.image_height), int(camera.image_width), math.tan(camera.FoVx * 0.5), math.tan(camera.FoVy * 0.5),
        background, 1.0, camera.world_view_transform, camera.full_proj_transform, pc.active_sh_degree,
        camera.camera_center, False, False, False,
    )  # fmt: skip
    image, radii, depth = GaussianRasterizer(raster_settings=settings)(
        means3D=pc.get_xyz, means2D=torch.zeros_like(pc.get_xyz), shs=pc.get_features, colors_precomp=None,
        opacities=pc.get_opacity, scales=pc.get_scaling, rotations=pc.get_rotation, cov3D_precomp=None,
    )  # fmt: skip
    return image.clamp(0, 1), radii, depth


def difference(pc, camera, background):
    with torch.no_grad():
        package, (image, radii, depth) = render(camera, pc, pipe, background), rasterized(camera, pc, background)
    assert package["render"].max() > 0.2 and torch.equal(package["radii"], radii)
    return max((package["render"] - image).abs().max().item(), (package["depth"] - depth).abs().max().item())


source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
args = parser.parse_args(["-s", source, "-m", model, "--eval"])
dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
trained = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, trained, load_iteration=-1, shuffle=False)
background = torch.tensor([0.1, 0.2, 0.3], device="cuda")
views = scene.getTrainCameras()

foreign = DecodedGaussians(trained).cuda()
with torch.no_grad():
    usual = render(views[0], trained, pipe, background)["render"]
    result = {"foreign": (render(views[0], foreign, pipe, background)["render"] - usual).abs().max().item()}
result["foreign_rasterized"] = difference(foreign, views[1], background)
optimizer = torch.optim.Adam(foreign.parameters(), lr=0.005)
losses = []
for step in range(20):
    view = views[step % 3]
    package = render(view, foreign, pipe, background)
    loss = l1_loss(package["render"], view.original_image.cuda())
    loss.backward()
    assert package["viewspace_points"].grad.shape == foreign.get_xyz.shape
    optimizer.step()
    optimizer.zero_grad()
    losses.append(loss.item())
result["foreign_losses"] = losses

soft = SoftplusModel(dataset.sh_degree)
fresh = parser.parse_args(["-s", source, "-m", os.path.join(out, "soft"), "--eval"])
os.makedirs(fresh.model_path)
Scene(lp.extract(fresh), soft)
with torch.no_grad():
    soft._scaling.copy_(soft.scaling_inverse_activation(torch.full_like(soft._scaling, 0.03)))
soft.training_setup(opt)
result["soft_scale"] = [soft.get_scaling.min().item(), soft.get_scaling.max().item()]
result["soft"] = difference(soft, views[0], background)
pipe.compute_cov3D_python = True
result["soft_covariance"] = difference(soft, views[0], background)
pipe.compute_cov3D_python = False
losses, counts = [], [len(soft.get_xyz)]
for step in range(1, 31):
    view = views[step % 3]
    package = render(view, soft, pipe, background)
    loss = l1_loss(package["render"], view.original_image.cuda())
    loss.backward()
    losses.append(loss.item())
    with torch.no_grad():
        soft.add_densification_stats(package["viewspace_points"], package["visibility_filter"])
        if step == 15:
            soft.densify_and_prune(1e-5, 0.005, 0.5, None, package["radii"])  # all are larger than 0.005: all split
            counts.append(len(soft.get_xyz))
            result["soft_split"] = [soft.get_scaling.min().item(), soft.get_scaling.max().item()]
        soft.optimizer.step()
        soft.optimizer.zero_grad(set_to_none=True)
result |= {"soft_losses": losses, "soft_counts": counts, "soft_trained": difference(soft, views[0], background)}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
