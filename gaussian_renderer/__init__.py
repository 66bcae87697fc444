"""Rendering of a model for a camera: the image, and the values for adaptive density control."""

import argparse
import math
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, rasterize
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.channels import rasterize_channels
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.scene import Drawing, Scene, scene_arguments
from diff_gaussian_rasterization.scene import draw as rasterize_scene
from torch import Tensor

from gaussian_renderer.over_ranks.sharded import (
    CachedBands,
    DividedDrawn,
    draw_divided,
    gradient_of_colors,
    rasterizer_of,
)
from scene.cameras import Camera, MiniCam
from scene.fused_adam import FusedAdam
from scene.gaussian_model import GaussianModel
from scene.gaussians.exposure import apply_exposure
from scene.gaussians.parameters import GaussianParameters
from scene.sleeping import Sleeping
from utils.general_utils import check_flags
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
    want_depth: bool = True,
    want_visibility: bool = True,
    want_inactive_bands: bool = True,
    want_absolute_gradient: bool = False,
    clamp: bool = True,
    features: Tensor | None = None,
) -> dict[str, Tensor | None]:
    """Render one view.

    viewpoint_camera: a Camera, or an object with the attributes of MiniCam. pc: a GaussianModel, or an object with its
    get_xyz, get_opacity, get_scaling, get_rotation, get_features and active_sh_degree.
    pipe: convert_SHs_python, compute_cov3D_python, debug and, if present, antialiasing and projection.
    bg_color: (3,) in [0, 1] on the model's device. scaling_modifier: factor of all scales.
    separate_sh: take get_features_dc and get_features_rest even if a subclass has overridden them; the 2023 release has
    override_color in its place. override_color: (N, 3) instead of SH. features: (N, F) further channels.
    use_trained_exp: apply the trained exposure of the view's photo, if it has one.

    Returns `render`: (3, H, W), clamped to [0, 1] so that values outside get no gradient; unclamped if clamp is False;
    `viewspace_points`: (N, 3), gets the gradient of the screen means, per NDC unit; the gradient's third column is 0,
    or with want_absolute_gradient the length of absolute gradients (see `rasterize`);
    `visibility_filter`: (n, 1) int64 indices of the Gaussians with radius > 0; None without want_visibility, so that no
    GPU is waited for; `radii`: (N,) int32 pixels; `depth`: inverse depth (1, H, W), 1 / world units, or None unless
    want_depth; `features`: with features, (F, H, W) over a background of 0; there is then no depth.
    Without want_inactive_bands, get_features_rest gets no gradient at the active degree 0, instead of zeros.
    TypeError for a flag that is neither True nor False, such as the text "no".
    """
    if torch.is_tensor(separate_sh):
        separate_sh, override_color = False, separate_sh
    check_flags(use_trained_exp=use_trained_exp, clamp=clamp)
    gaussians, raw = model_inputs(viewpoint_camera, pc, pipe, scaling_modifier, separate_sh, override_color)
    if gaussians.sh_rest is not None and pc.active_sh_degree == 0 and not want_inactive_bands:
        gaussians = gaussians._replace(sh_rest=gaussians.sh_rest.detach()[:, :0])
    viewspace_points = _make_screen_points(*gaussians)
    rasterizer = rasterizer_of(pc) if features is None else partial(_rasterize_features, rasterizer_of(pc), features)
    result = rasterizer(
        means2d=viewspace_points,
        settings=rasterizer_settings(viewpoint_camera, pc, pipe, bg_color, scaling_modifier),
        want_inverse_depth=want_depth,
        want_absolute_gradient=want_absolute_gradient,
        raw=raw,
        **gaussians._asdict(),
    )
    color = apply_trained_exposure(result.color, viewpoint_camera, pc) if use_trained_exp else result.color
    return {
        "render": color.clamp(0, 1) if clamp else color,
        "viewspace_points": viewspace_points,
        "visibility_filter": (result.radii > 0).nonzero() if want_visibility else None,
        "radii": result.radii,
        "depth": to_world_units(result.inverse_depth, pc),
    } | ({} if features is None else {"features": result.features})


class _Featured(NamedTuple):
    """An image with features, with the fields that `render` reads."""

    color: Tensor
    radii: Tensor
    inverse_depth: None
    features: Tensor


def _rasterize_features(
    rasterizer: Callable,
    features: Tensor,
    *,
    settings: GaussianRasterizationSettings,
    want_inverse_depth: bool,
    **given,
) -> _Featured:
    """Rasterize colours and the features (N, C) in one pass, as an image of 3 + C channels, and split the result.

    ValueError for a model that is divided among processes.
    """
    if rasterizer is not rasterize:
        raise ValueError("features need a model that is not divided among processes")
    behind = torch.nn.functional.pad(settings.bg.reshape(-1), (0, features.shape[-1]))
    found = rasterize_channels(settings=settings._replace(bg=behind), features=features, **given)
    return _Featured(found.image[:3], found.radii, None, found.image[3:])


def _make_screen_points(xyz: Tensor, *others: Tensor | None) -> Tensor:
    """Zeros (N, 3) that take a gradient if one of the tensors does."""
    points = _make_zero(xyz.device, xyz.dtype).expand_as(xyz)
    differentiated = any(x is not None and x.requires_grad for x in (xyz, *others))
    return points.requires_grad_(torch.is_grad_enabled() and differentiated)


@cache
def _make_zero(device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):  # so that training can use it after a render in inference mode
        return torch.zeros((), device=device, dtype=dtype)


class Drawn:
    """A rendered view: image (3, H, W), inverse depth (1, H, W) if requested, and a backward from their gradients.

    The inverse depth is in the rasterizer's unit (`to_world_units`). Both may be given `requires_grad`. DividedDrawn
    has the same attributes and methods.

    blend_depth: (H, W) int32, number of entries of its tile's list that a pixel reads.
    band: None, as all rows of the image are valid.
    """

    band = None

    def __init__(
        self, drawing: Drawing, scene: Scene, background: Tensor, want_depth: bool, awake: Tensor | None = None
    ) -> None:
        """Keep a drawn view and what its gradients need. awake: the blocks of Gaussians that take part, None: all."""
        self.image, self.depth = drawing.color, drawing.inverse_depth if want_depth else None
        self.radii, self.blend_depth = drawing.radii, drawing.last
        self._drawing, self._scene, self._background, self._awake = drawing, scene, background, awake

    def decisive(self) -> Tensor:
        """Gaussians that the image depends on (`decisive` of diff_gaussian_rasterization): (N,) bool."""
        it = self._drawing
        return OPERATORS.decisive(it.splats, it.instances, it.ranges, it.last, self._scene.lens)

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """The gradient of the Gaussians' colours (N, 3), whether these were given or came from SH bands."""
        return gradient_of_colors(self._scene, self._drawing.kept(self._background), (image_gradient, None, None))

    @torch.no_grad()
    def camera_gradient(self, image_gradient: Tensor, depth_gradient: Tensor | None) -> Tensor:
        """The gradients of the camera's numbers (diff_gaussian_rasterization/camera.py), float64."""
        kept = self._drawing.kept(self._background)
        rows = OPERATORS.blend_rows(kept, image_gradient, None, depth_gradient)
        return OPERATORS.sum_blocks(OPERATORS.camera_vjp(*self._scene, [*kept[:2], *rows]))

    def step(
        self,
        adam: FusedAdam,
        image_gradient: Tensor,
        depth_gradient: Tensor | None,
        observe: bool,
        absolute: bool = False,
        now: Tensor | None = None,
        camera: Tensor | None = None,
    ) -> None:
        """Take the optimiser's step of every Gaussian, without storing parameter gradients.

        Values, averages and statistics get the same bits as by `render`, backward, `observe` and the optimiser's step.

        observe: add the view to the statistics of density control.
        absolute: use the lengths of absolute gradients (`rasterize` of diff_gaussian_rasterization).
        now: (NOW_WORDS,) int64 on the Gaussians' device, from `FusedAdam.write_now`, for a step that is captured.
        camera: receives the gradients of `camera_gradient` (`FusedAdam`).
        """
        source, planes = self._drawing.kept(self._background), (image_gradient, None, depth_gradient)
        adam.apply(self._scene, source, planes, self.radii, observe, absolute and observe, now, camera, self._awake)


@torch.no_grad()
def draw(
    camera: Camera | MiniCam,
    pc: GaussianModel,
    pipe: argparse.Namespace,
    background: Tensor,
    want_depth: bool = False,
    scaling: float = 1.0,
    by_bands: bool = False,
    bands: CachedBands | None = None,
    sleeping: Sleeping | None = None,
    now: Tensor | None = None,
) -> Drawn | DividedDrawn:
    """Render a view without autograd; the result's methods compute gradients.

    by_bands: with a model divided among ranks, each rank needs only the pixels for the loss of its band.
    bands: with a divided model, the bands of earlier steps; the camera's uid stands for the view.
    sleeping: the model's sleeping blocks; those that the view may show wake.
    now: numbers of the step on the GPU, for a step that a CUDA graph repeats (`Sleeping.wake`); else None.
    """
    gaussians, raw = model_inputs(camera, pc, pipe, scaling)
    scene = scene_arguments(gaussians, rasterizer_settings(camera, pc, pipe, background, scaling), raw)
    awake = None
    if sleeping is not None:
        awake = sleeping.wake(scene, now)
    divided = draw_divided(pc, scene, background, want_depth, by_bands, bands, camera, awake)
    if divided is not None:
        return divided
    return Drawn(rasterize_scene(scene, background, want_depth, awake=awake), scene, background, want_depth, awake)


@torch.no_grad()
def wake(sleeping: Sleeping, camera: Camera, pc: GaussianModel, pipe: argparse.Namespace, background: Tensor) -> None:
    """Wake the blocks of a model that a view may show, before a step that uses `render`."""
    gaussians, raw = model_inputs(camera, pc, pipe)
    sleeping.wake(scene_arguments(gaussians, rasterizer_settings(camera, pc, pipe, background), raw))


@torch.no_grad()
def visible_mask(camera: Camera | MiniCam, pc: GaussianModel, pipe: argparse.Namespace) -> Tensor:
    """Mark this process's Gaussians that reach a tile of a view: (N,) bool."""
    gaussians, raw = model_inputs(camera, pc, pipe)
    settings = rasterizer_settings(camera, pc, pipe, pc.get_xyz.new_zeros(3))
    return OPERATORS.project(*scene_arguments(gaussians, settings, raw))[3] > 0


def decisive_for(camera: Camera | MiniCam, pc: GaussianModel, pipe: argparse.Namespace) -> Tensor:
    """Mark the Gaussians that the image of `render` depends on, over any background (`decisive`): (N,) bool."""
    return draw(camera, pc, pipe, pc.get_xyz.detach().new_zeros(3), by_bands=True).decisive()


def model_inputs(
    camera: Camera | MiniCam,
    pc: GaussianModel,
    pipe: argparse.Namespace,
    scaling: float = 1.0,
    separate_sh: bool = False,
    override_color: Tensor | None = None,
) -> tuple[Gaussians, bool]:
    """The rasterizer's inputs for a view of a model, and whether they are raw. Arguments as for `render`."""
    geometry, raw = _choose_geometry(pc, pipe.compute_cov3D_python, scaling)
    colors = _choose_colors(pc, pipe.convert_SHs_python, camera, separate_sh, override_color)
    return Gaussians(pc.get_xyz, **geometry, **colors), raw


def rasterizer_settings(
    camera: Camera | MiniCam, pc: GaussianModel, pipe: argparse.Namespace, background: Tensor, scaling: float = 1.0
) -> GaussianRasterizationSettings:
    """The rasterizer's settings for a view of a model; arguments as for `render`."""
    view, full = _enlarge_matrices(camera, pc)
    return GaussianRasterizationSettings(
        image_height=int(camera.image_height),
        image_width=int(camera.image_width),
        tanfovx=math.tan(camera.FoVx / 2),
        tanfovy=math.tan(camera.FoVy / 2),
        bg=background,
        scale_modifier=scaling,
        viewmatrix=view,
        projmatrix=full,
        sh_degree=pc.active_sh_degree,
        campos=camera.camera_center,
        prefiltered=False,
        debug=pipe.debug,
        antialiasing=getattr(pipe, "antialiasing", False),  # the 2023 release's options have none
        lens=getattr(camera, "lens", None),  # new in ours, as is the next
        projection=getattr(pipe, "projection", "ewa"),
    )


def _enlarge_matrices(camera: Camera | MiniCam, pc: GaussianModel) -> tuple[Tensor, Tensor]:
    """The camera's matrices in a frame that is larger than the world's by a model's enlargement.

    Only the nearest depth that is drawn changes.
    """
    view, full, factor = camera.world_view_transform, camera.full_proj_transform, enlargement_of(pc)
    if factor == 1:
        return view, full
    return torch.cat((factor * view[:, :3], view[:, 3:]), dim=1), factor * full


def to_world_units(inverse_depth: Tensor | None, pc: GaussianModel) -> Tensor | None:
    """Convert inverse depth, or its gradient, from the rasterizer's unit to the world's; differentiable."""
    factor = enlargement_of(pc)
    return inverse_depth if inverse_depth is None or factor == 1 else factor * inverse_depth


def enlargement_of(pc: GaussianModel) -> float:
    """The enlargement of a model; 1 for a model of other code that has none."""
    return getattr(pc, "enlargement", 1.0)


def apply_trained_exposure(color: Tensor, camera: Camera | MiniCam, pc: GaussianModel) -> Tensor:
    """Apply the trained exposure of the view's photo to an image (3, H, W); without a photo, return it unchanged."""
    name = photo_name(camera)
    if name is not None and (shown := getattr(getattr(pc, "exposures", None), "shown", None)):
        return shown(color, name)
    return color if name is None else apply_exposure(color, pc.get_exposure_from_name(name))


def photo_name(camera: Camera | MiniCam) -> str | None:
    """The name of a view's photo among the trained exposures; None for a view without a photo."""
    name = getattr(camera, "exposure_name", None)
    return getattr(camera, "image_name", None) if name is None else name


def _choose_geometry(pc: GaussianModel, in_python: bool, scaling_modifier: float) -> tuple[dict[str, Tensor], bool]:
    """Return shapes and opacities, and whether they are raw, so that the kernels activate them.

    The kernels are faster and give the same bits for any number of threads. A model with activations of its own, or of
    another class, even one that wraps a model of ours, gives activated values.
    """
    check_flags(compute_cov3D_python=in_python)
    if in_python:
        return {"opacities": pc.get_opacity, "cov3d": pc.get_covariance(scaling_modifier)}, False
    if isinstance(pc, GaussianParameters) and pc.kernels_activate:
        return pc.raw_geometry(), True
    return {"opacities": pc.get_opacity, "scales": pc.get_scaling, "rotations": pc.get_rotation}, False


def _choose_colors(
    pc: GaussianModel, in_python: bool, camera: Camera | MiniCam, separate_sh: bool, override_color: Tensor | None
) -> dict[str, Tensor]:
    """Choose the rasterizer's colour arguments: `override_color` (N, 3), colours computed here, or SH coefficients."""
    check_flags(convert_SHs_python=in_python, separate_sh=separate_sh)
    if override_color is not None:
        return {"colors": override_color}
    if in_python:
        direction = torch.nn.functional.normalize(pc.get_xyz - camera.camera_center.to(pc.get_xyz.dtype))
        color = eval_sh(pc.active_sh_degree, pc.get_features.transpose(1, 2), direction)
        return {"colors": (color + 0.5).clamp_min(0.0)}
    if separate_sh or (isinstance(pc, GaussianParameters) and pc.features_are_raw):
        dc, rest = pc.get_features_dc, pc.get_features_rest
    else:
        features = pc.get_features
        dc, rest = features[:, :1], features[:, 1:]
    return {"sh_dc": dc, "sh_rest": rest}
