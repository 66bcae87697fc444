"""Splats of a model, and a model of splats."""

import torch

from exports.splats import Splats
from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import attributes
from utils.general_utils import inverse_sigmoid


@torch.no_grad()
def splats_of(gaussians: GaussianModel, antialiasing: bool = False) -> Splats:
    """The Gaussians of a model, on the CPU. Other activations than ours are undone, as files hold logits and logs."""
    if gaussians.kernels_activate:
        raw = gaussians.raw_geometry()
        scales, logits = raw["scales"], raw["opacities"]
    else:
        scales, logits = gaussians.get_scaling.log(), inverse_sigmoid(gaussians.get_opacity)
    values = (gaussians.get_xyz, scales, gaussians.get_rotation, logits[:, 0], gaussians.get_features)
    means, scales, rotations, logits, sh = (x.detach().float().cpu().contiguous().numpy() for x in values)
    return Splats(means, scales, rotations, logits, sh, antialiasing, gaussians.world_offset)


def model_of(splats: Splats, sh_degree: int | None = None) -> GaussianModel:
    """A model, on the device that computes, whose SH bands are all active. sh_degree: of the model, None: the splats'.

    Bands that the splats lack are zero; those above sh_degree are left out.
    """
    degree = splats.sh_degree if sh_degree is None else sh_degree
    gaussians = GaussianModel(degree)
    fill_model(gaussians, splats)
    return gaussians


def fill_model(gaussians: GaussianModel, splats: Splats) -> None:
    """Give a model these Gaussians, with the bands that it has. The splats' bands become active.

    Attributes that splats do not have get the values of new Gaussians.
    """
    bands = (gaussians.max_sh_degree + 1) ** 2
    sh = torch.from_numpy(splats.sh[:, :bands])
    sh = torch.nn.functional.pad(sh, (0, 0, 0, bands - sh.shape[1]))
    rows = {
        "xyz": torch.from_numpy(splats.means),
        "f_dc": sh[:, :1].contiguous(),
        "f_rest": sh[:, 1:].contiguous(),
        "opacity": torch.from_numpy(splats.opacity_logits)[:, None],
        "scaling": torch.from_numpy(splats.log_scales),
        "rotation": torch.from_numpy(splats.rotations),
    }
    started = attributes(gaussians.max_sh_degree).items()
    further = {name: torch.full((len(splats), *a.shape), a.start) for name, a in started if name not in rows}
    gaussians.take_whole(rows | further)
    gaussians.active_sh_degree = min(gaussians.max_sh_degree, splats.sh_degree)
