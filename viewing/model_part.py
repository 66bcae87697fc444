"""The part of a model that a frame shows; the model itself does not change."""

import copy

import torch
from torch import Tensor

from scene.gaussian_model import GaussianModel
from viewing.settings import Settings, Vector


@torch.no_grad()
def shown_part(gaussians: GaussianModel, settings: Settings) -> GaussianModel:
    """The Gaussians in the crop box, with the SH degree of the settings at most."""
    degree = min(settings.sh_degree, gaussians.active_sh_degree)
    if settings.crop is not None:
        part = gaussians.part(inside(gaussians.get_xyz, *settings.crop), gaussians.max_sh_degree)
    elif degree == gaussians.active_sh_degree:
        return gaussians
    else:
        part = copy.copy(gaussians)  # shares the tensors
    part.active_sh_degree = degree
    return part


def inside(positions: Tensor, one: Vector, other: Vector) -> Tensor:
    """(N,) bool: which positions (N, 3) lie in the box with these opposite corners."""
    corners = positions.new_tensor([one, other])
    return ((positions >= corners.amin(0)) & (positions <= corners.amax(0))).all(1)
