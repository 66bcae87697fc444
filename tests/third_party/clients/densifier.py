"""Density control of one's own: a subclass of the model with a label per Gaussian, another optimiser, and a network.

SCENE MODEL OUT
"""

import json
import os
import sys
from argparse import ArgumentParser

import torch
from torch import nn

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.general_utils import build_rotation
from utils.loss_utils import l1_loss

FIELDS = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}


class ErrorDensifier(GaussianModel):
    """Clones and splits the Gaussians with the largest gradients, with radii carried along in tmp_radii."""

    def copied(self, mask, times=1):
        return {
            name: getattr(self, field)[mask].repeat(times, *[1] * (getattr(self, field).dim() - 1))
            for name, field in FIELDS.items()
        }

    def append(self, new, radii):
        self.densification_postfix(
            new["xyz"], new["f_dc"], new["f_rest"], new["opacity"], new["scaling"], new["rotation"], radii
        )

    def densify_by_rank(self, share, extent, radii):
        grads = self.xyz_gradient_accum / self.denom
        grads[grads.isnan()] = 0.0
        self.tmp_radii = radii
        chosen = grads.squeeze() >= torch.quantile(grads.squeeze(), 1 - share)
        small = torch.max(self.get_scaling, dim=1).values <= self.percent_dense * extent
        clone = torch.logical_and(chosen, small)
        self.append(self.copied(clone), self.tmp_radii[clone])
        split = torch.zeros(self.get_xyz.shape[0], dtype=torch.bool, device="cuda")
        split[: len(small)] = torch.logical_and(chosen, ~small)
        new = self.copied(split, 2)
        stds = self.get_scaling[split].repeat(2, 1)
        samples = torch.normal(mean=torch.zeros_like(stds), std=stds)
        rotations = build_rotation(self._rotation[split]).repeat(2, 1, 1)
        new["xyz"] = torch.bmm(rotations, samples.unsqueeze(-1)).squeeze(-1) + self.get_xyz[split].repeat(2, 1)
        new["scaling"] = self.scaling_inverse_activation(self.get_scaling[split].repeat(2, 1) / 1.6)
        self.append(new, self.tmp_radii[split].repeat(2))
        self.prune_points(torch.cat((split, torch.zeros(2 * int(split.sum()), device="cuda", dtype=bool))))
        assert self.tmp_radii.shape[0] == self.get_xyz.shape[0] == self.max_radii2D.shape[0]
        counts = int(clone.sum()), int(split.sum())
        self.tmp_radii = None
        torch.cuda.empty_cache()
        return counts

    def soften(self):
        """Halve all opacities, as an opacity reset does it."""
        value = self.inverse_opacity_activation(self.get_opacity * 0.5)
        self._opacity = self.replace_tensor_to_optimizer(value, "opacity")["opacity"]


class LabelledModel(ErrorDensifier):
    """A model with one more parameter (N, 4), in a group of the optimiser that grows and shrinks with the others."""

    def training_setup(self, training_args):
        super().training_setup(training_args)
        self._label = nn.Parameter(torch.zeros((self.get_xyz.shape[0], 4), device="cuda"))
        self._label.data[:, 0] = torch.arange(len(self._label), device="cuda")
        self.optimizer.add_param_group({"params": [self._label], "lr": 0.01, "name": "label"})

    def copied(self, mask, times=1):
        return {**super().copied(mask, times), "label": self._label[mask].repeat(times, 1)}

    def append(self, new, radii):
        tensors = self.cat_tensors_to_optimizer(new)
        for name, field in {**FIELDS, "label": "_label"}.items():
            setattr(self, field, tensors[name])
        self.tmp_radii = torch.cat((self.tmp_radii, radii))
        count = self.get_xyz.shape[0]
        self.xyz_gradient_accum = torch.zeros((count, 1), device="cuda")
        self.denom = torch.zeros((count, 1), device="cuda")
        self.max_radii2D = torch.zeros((count), device="cuda")

    def prune_points(self, mask):
        super().prune_points(mask)
        (self._label,) = (group["params"][0] for group in self.optimizer.param_groups if group["name"] == "label")


class CutByHand(ErrorDensifier):
    """Prunes by `_prune_optimizer` itself."""

    def prune_points(self, mask):
        tensors = self._prune_optimizer(~mask)
        for name, field in FIELDS.items():
            setattr(self, field, tensors[name])
        self.xyz_gradient_accum, self.denom = self.xyz_gradient_accum[~mask], self.denom[~mask]
        self.max_radii2D, self.tmp_radii = self.max_radii2D[~mask], self.tmp_radii[~mask]


source, model, out = sys.argv[1:4]
parser = ArgumentParser()
lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
background = torch.zeros(3, device="cuda")


def train(name, kind, own_adam=False, network=None, steps=40):
    """Train with this density control; losses, numbers of Gaussians, and checks of the rows that stay."""
    args = parser.parse_args(["-s", source, "-m", os.path.join(out, name), "--eval"])
    dataset, opt, pipe = lp.extract(args), op.extract(args), pp.extract(args)
    os.makedirs(dataset.model_path)
    gaussians = kind(dataset.sh_degree)
    scene = Scene(dataset, gaussians, shuffle=False)
    gaussians.training_setup(opt)
    if own_adam:
        groups = [
            {"params": group["params"], "lr": group["lr"], "name": group["name"]}
            for group in gaussians.optimizer.param_groups
        ]
        gaussians.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    result = {"losses": [], "counts": [len(gaussians.get_xyz)], "changes": []}
    for step in range(1, steps + 1):
        gaussians.update_learning_rate(step)
        if step % 10 == 0:
            gaussians.oneupSHdegree()
        camera = scene.getTrainCameras()[step % 6]
        package = render(camera, gaussians, pipe, background)
        image = package["render"]
        if network is not None:
            if step == 1:
                gaussians.optimizer.add_param_group({"params": list(network.parameters()), "lr": 0.001, "name": "mlp"})
            image = image + 0.1 * network(image.permute(1, 2, 0)).permute(2, 0, 1)
        loss = l1_loss(image, camera.original_image.cuda())
        if isinstance(gaussians, LabelledModel):
            loss = loss + 1e-3 * gaussians._label[:, 1].sub(1).abs().mean()
        loss.backward()
        result["losses"].append(loss.item())
        with torch.no_grad():
            seen, radii = package["visibility_filter"], package["radii"]
            gaussians.max_radii2D[seen] = torch.max(gaussians.max_radii2D[seen], radii[seen])
            gaussians.add_densification_stats(package["viewspace_points"], seen)
            if step in (15, 30) and network is None:
                result["changes"].append(gaussians.densify_by_rank(0.3, scene.cameras_extent, radii))
                result["counts"].append(len(gaussians.get_xyz))
            if step == 25 and network is None:
                before = gaussians.get_opacity.clone()
                gaussians.soften()
                result["softened"] = (gaussians.get_opacity / before).mean().item()
                gaussians.reset_opacity()
                result["reset"] = gaussians.get_opacity.max().item()
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
    groups = {group["name"]: group["params"][0] for group in gaussians.optimizer.param_groups}
    state = gaussians.optimizer.state[groups["xyz"]]
    result["same"] = all(getattr(gaussians, field) is groups[name] for name, field in FIELDS.items())
    result["moments"] = [list(state["exp_avg"].shape), list(state["exp_avg_sq"].shape), float(state["step"])]
    result["rest_moved"] = gaussians._features_rest.abs().max().item()
    if isinstance(gaussians, LabelledModel):
        result["labels"] = [list(gaussians._label.shape), len(gaussians._label[:, 0].round().unique())]
        result["label_trained"] = gaussians._label[:, 1].max().item()
    if network is not None:
        result["network_moved"] = max(
            (p - q).abs().max().item() for p, q in zip(network.parameters(), start, strict=True)
        )
    scene.save(steps)
    return result


torch.manual_seed(0)
result = {
    "base": train("base", ErrorDensifier),
    "by_hand": train("by_hand", CutByHand),
    "labelled": train("labelled", LabelledModel),
    "own_adam": train("own_adam", ErrorDensifier, own_adam=True),
    "own_adam_labelled": train("own_adam_labelled", LabelledModel, own_adam=True),
}
network = nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 3)).cuda()
start = [parameter.detach().clone() for parameter in network.parameters()]
result["network"] = train("network", GaussianModel, network=network)
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
