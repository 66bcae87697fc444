"""The frame that a remote viewer asks for, as the bytes that it gets."""

import argparse

import torch
from torch import Tensor

from gaussian_renderer import render
from gaussian_renderer.network_message import Request
from scene.gaussian_model import GaussianModel


@torch.no_grad()
def frame_bytes(request: Request, gaussians: GaussianModel, pipe: argparse.Namespace, background: Tensor) -> memoryview:
    """RGB bytes (H, W, 3) of the model as `render` shows it: 255 times the colour, truncated.

    pipe: options of the training, which stay as they are; for the frame, the request's two switches count instead.
    """
    switches = {"convert_SHs_python": request.shs_python, "compute_cov3D_python": request.rot_scale_python}
    image = render(
        request.camera(background.device),
        gaussians,
        argparse.Namespace(**vars(pipe) | switches),
        background,
        request.scaling_modifier,
        want_depth=False,
        want_visibility=False,
    )["render"]
    return memoryview((image * 255).byte().permute(1, 2, 0).contiguous().cpu().numpy())
