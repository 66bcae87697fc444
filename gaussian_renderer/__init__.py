"""Rendering of a model for a camera: the image, and the values that adaptive density control needs."""

import argparse
import math
from functools import cache

import utils.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, decisive, rasterize
from torch import Tensor

from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from scene.gaussians.exposure import apply_exposure
from utils.sh_utils import eval_sh


def render(
    viewpoint_camera: Camera | MiniCam,
    pc: GaussianModel,
    pipe: argparse.Namespace,
    bg_color: Tensor,
    scaling_modifier: float = 1.0,
    separate_sh: bool = False,
    override_color: Tensor | None = None,
    use_trained_exp: bool = False,
    *,
    want_depth: bool = False,
    want_visibility: bool = True,
    clamp: bool = True,
) -> dict[str, Tensor | None]:
    """Render one view.

    bg_color: (3,) in [0, 1] on the model's device. scaling_modifier multiplies all scales. override_color: (N, 3)
    instead of SH. separate_sh: accepted for callers of the reference; the SH bands are always passed separately.
    pipe: convert_SHs_python, compute_cov3D_python, debug, antialiasing. use_trained_exp: apply the trained exposure of
    the view's photo, before the clamp; a view without a photo has none.

    Returns
    `render` (3, H, W), clamped to [0, 1] so that values outside get no gradient; unclamped if clamp is False;
    `viewspace_points` (N, 3), whose gradient is that of the screen means, per NDC unit;
    `visibility_filter` (n, 1) int64 indices of the Gaussians with radius > 0, or None without want_visibility, which
    saves waiting for a GPU; `radii` (N,) int32 pixels; `depth` inverse depth (1, H, W), or None unless want_depth.
    """
    xyz = pc.get_xyz
    viewspace_points = _zero(xyz.device, xyz.dtype).expand_as(xyz)
    viewspace_points.requires_grad_(xyz.requires_grad and torch.is_grad_enabled())
    result = rasterize(
        xyz,
        viewspace_points,
        settings=_settings(viewpoint_camera, pc.active_sh_degree, pipe, bg_color, scaling_modifier),
        want_inverse_depth=want_depth,
        **_geometry(pc, pipe.compute_cov3D_python, scaling_modifier),
        **_colors(pc, pipe.convert_SHs_python, viewpoint_camera, override_color),
    )
    color = result.color
    if use_trained_exp and (name := getattr(viewpoint_camera, "exposure_name", None)) is not None:
        color = apply_exposure(color, pc.get_exposure_from_name(name))
    return {
        "render": color.clamp(0, 1) if clamp else color,
        "viewspace_points": viewspace_points,
        "visibility_filter": (result.radii > 0).nonzero() if want_visibility else None,
        "radii": result.radii,
        "depth": result.inverse_depth,
    }


@cache
def _zero(device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):  # so that training can use it after a render in inference mode
        return torch.zeros((), device=device, dtype=dtype)


@torch.no_grad()
def decisive_for(camera: Camera | MiniCam, pc: GaussianModel, pipe: argparse.Namespace) -> Tensor:
    """Gaussians that the image of `render` depends on, over any background (`decisive`): (N,) bool."""
    background = pc.get_xyz.new_zeros(3)
    return decisive(
        pc.get_xyz,
        settings=_settings(camera, pc.active_sh_degree, pipe, background, 1.0),
        **_geometry(pc, pipe.compute_cov3D_python, 1.0),
        **_colors(pc, pipe.convert_SHs_python, camera, None),
    )


def _settings(
    camera: Camera | MiniCam, sh_degree: int, pipe: argparse.Namespace, background: Tensor, scaling_modifier: float
) -> GaussianRasterizationSettings:
    return GaussianRasterizationSettings(
        image_height=int(camera.image_height),
        image_width=int(camera.image_width),
        tanfovx=math.tan(camera.FoVx / 2),
        tanfovy=math.tan(camera.FoVy / 2),
        bg=background,
        scale_modifier=scaling_modifier,
        viewmatrix=camera.world_view_transform,
        projmatrix=camera.full_proj_transform,
        sh_degree=sh_degree,
        campos=camera.camera_center,
        prefiltered=False,
        debug=pipe.debug,
        antialiasing=pipe.antialiasing,
    )


def _geometry(pc: GaussianModel, in_python: bool, scaling_modifier: float) -> dict[str, Tensor | bool]:
    """Shapes and opacities: raw, so that the kernels activate them, or activated and multiplied out in PyTorch.

    The kernels are faster and give the same bits for any number of threads.
    """
    if in_python:
        return {"opacities": pc.get_opacity, "cov3d": pc.get_covariance(scaling_modifier)}
    return {**pc.raw_geometry(), "raw": True}


def _colors(
    pc: GaussianModel, in_python: bool, camera: Camera | MiniCam, override_color: Tensor | None
) -> dict[str, Tensor]:
    if override_color is not None:
        return {"colors": override_color}
    if in_python:
        direction = torch.nn.functional.normalize(pc.get_xyz - camera.camera_center)
        color = eval_sh(pc.active_sh_degree, pc.get_features.transpose(1, 2), direction)
        return {"colors": (color + 0.5).clamp_min(0.0)}
    rest = pc.get_features_rest
    if pc.active_bands == 0:
        rest = rest.detach()[:, :0]  # no band is read, so no gradient of zeros has to be written
    return {"sh_dc": pc.get_features_dc, "sh_rest": rest}
