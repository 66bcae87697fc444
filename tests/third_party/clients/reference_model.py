"""A model class of one's own with the checkpoints and PLY files of the releases: RELEASE is 2023 or 2024.

SCENE MODEL OUT RELEASE: trains on from the project's checkpoint of iteration 300, writes a checkpoint and PLY files.
"""

import json
import os
import sys
from argparse import ArgumentParser

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import nn

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss

TENSORS = ("_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity")


class PlainModel:
    """Six tensors and torch's Adam. Entries of a checkpoint are taken as they are."""

    def __init__(self, sh_degree):
        self.max_sh_degree, self.active_sh_degree, self.optimizer = sh_degree, 0, None

    get_xyz = property(lambda self: self._xyz)
    get_features = property(lambda self: torch.cat((self._features_dc, self._features_rest), dim=1))
    get_features_dc = property(lambda self: self._features_dc)
    get_features_rest = property(lambda self: self._features_rest)
    get_opacity = property(lambda self: torch.sigmoid(self._opacity))
    get_scaling = property(lambda self: torch.exp(self._scaling))
    get_rotation = property(lambda self: nn.functional.normalize(self._rotation))

    def training_setup(self, opt):
        rates = {
            "xyz": opt.position_lr_init * self.spatial_lr_scale, "f_dc": opt.feature_lr, "f_rest": opt.feature_lr / 20,
            "opacity": opt.opacity_lr, "scaling": opt.scaling_lr, "rotation": opt.rotation_lr,
        }  # fmt: skip
        fields = ("_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_rotation")
        self.optimizer = torch.optim.Adam(
            [
                {"params": [getattr(self, field)], "lr": rate, "name": name}
                for field, (name, rate) in zip(fields, rates.items(), strict=True)
            ],
            lr=0.0,
            eps=1e-15,
        )

    def capture(self):
        tensors = [getattr(self, name) for name in TENSORS]
        statistics = (self.max_radii2D, self.xyz_gradient_accum, self.denom)
        return (self.active_sh_degree, *tensors, *statistics, self.optimizer.state_dict(), self.spatial_lr_scale)

    def restore(self, entries, opt):
        self.active_sh_degree = entries[0]
        for name, tensor in zip(TENSORS, entries[1:7], strict=True):
            setattr(self, name, tensor)
        self.max_radii2D, self.xyz_gradient_accum, self.denom, state, self.spatial_lr_scale = entries[7:12]
        self.training_setup(opt)
        self.optimizer.load_state_dict(state)

    def save_ply(self, path):
        xyz, dc, rest, scale, rotation, opacity = (getattr(self, name).detach().cpu() for name in TENSORS)
        flat = [bands.transpose(1, 2).flatten(start_dim=1) for bands in (dc, rest)]
        names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(flat[0].shape[1]))]
        names += [*(f"f_rest_{i}" for i in range(flat[1].shape[1])), "opacity"]
        names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
        table = np.concatenate([xyz, np.zeros_like(xyz), *flat, opacity, scale, rotation], axis=1)
        elements = np.empty(len(table), dtype=[(name, "f4") for name in names])
        elements[:] = list(map(tuple, table))
        PlyData([PlyElement.describe(elements, "vertex")]).write(path)


class PlainModel2024(PlainModel):
    """With exposures, which neither checkpoint nor PLY holds."""

    def training_setup(self, opt):
        super().training_setup(opt)
        self._exposure = nn.Parameter(torch.eye(3, 4, device="cuda")[None])
        self.exposure_optimizer = torch.optim.Adam([self._exposure])


source, model, out, release = sys.argv[1:5]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
args = parser.parse_args(["-s", source, "-m", os.path.join(out, "views"), "--eval"])
dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
os.makedirs(dataset.model_path)
project = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, project, shuffle=False)
background = torch.zeros(3, device="cuda")
checkpoint = os.path.join(model, "chkpnt300.pth")
result = {"entries": []}

# Restored with both ways of loading; training goes on only if the tensors want gradients.
for safe in (True, False):
    (entries, first) = torch.load(checkpoint, weights_only=safe)
    plain = (PlainModel2024 if release == "2024" else PlainModel)(dataset.sh_degree)
    plain.restore(entries, opt)
    result["entries"].append([len(entries), first, all(getattr(plain, name).requires_grad for name in TENSORS)])
    losses = []
    for iteration in range(first + 1, first + 21):
        camera = scene.getTrainCameras()[iteration % 4]
        loss = l1_loss(render(camera, plain, pipe, background)["render"], camera.original_image.cuda())
        loss.backward()
        plain.optimizer.step()
        plain.optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
result["losses"] = losses
result["steps"] = {name: float(plain.optimizer.state[getattr(plain, name)]["step"]) for name in TENSORS}

plain.spatial_lr_scale = np.float32(scene.cameras_extent) if release == "2023" else np.float64(scene.cameras_extent)
torch.save((plain.capture(), iteration), os.path.join(out, f"chkpnt{iteration}.pth"))
plain.save_ply(os.path.join(out, "theirs.ply"))
project.load_ply(os.path.join(out, "theirs.ply"))
project.save_ply(os.path.join(out, "ours.ply"))
result["read"] = max((getattr(plain, name) - getattr(project, name)).abs().max().item() for name in TENSORS)
project.restore(torch.load(os.path.join(out, f"chkpnt{iteration}.pth"), weights_only=False)[0], opt)
result["restored"] = max((getattr(plain, name) - getattr(project, name)).abs().max().item() for name in TENSORS)
result["count"] = len(plain.get_xyz)
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
