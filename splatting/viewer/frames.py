"""The image of a frame: what the settings ask for, from a pose; and the colours of depth, counts and errors."""

import argparse
import copy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer import render
from gaussian_renderer.blending import blend_depth, view_planes
from gaussian_renderer.free_view import free_view
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from splatting.files.image_files import to_bytes
from splatting.viewer import views
from splatting.viewer.views import Pose, SceneCameras, Settings, Vector, canvas
from utils.image_utils import as_float

LONGEST = 1600  # pixels of a frame's longer side, at most
COARSE = 2  # a frame of a moving camera has a quarter of the pixels
_BORDER = 0.15  # grey around a target that does not fill the window
_LINE = 2  # pixels of the slider's line
ERROR_GAIN = 5  # as in the contact sheets
_FEW, _MOST = 0.02, 0.98  # quantiles of the depths of a frame that get the darkest and the brightest colour
_SAMPLE = 20_000  # pixels that the quantiles are taken from
# From dark to bright, so that a grey print keeps the order.
_STOPS = ((0.00, 0.00, 0.05), (0.25, 0.05, 0.42), (0.70, 0.18, 0.38), (0.97, 0.50, 0.16), (0.99, 1.00, 0.70))


class Frames:
    """Draws frames of a model. with_exposures: as `use_trained_exp` of `render`, for an image beside its target.

    Used by one thread. Nothing of the model changes.
    """

    def __init__(
        self, gaussians: GaussianModel, cameras: SceneCameras, pipe: argparse.Namespace, with_exposures: bool
    ) -> None:
        self._gaussians = gaussians
        self._cameras = cameras
        self._pipe = pipe
        self._with_exposures = with_exposures
        self._compared: tuple[object, tuple[Tensor, Tensor]] = (None, ())

    @torch.no_grad()
    def draw(self, settings: Settings, pose: Pose, coarse: bool, version: int = 0) -> np.ndarray:
        """A frame (H, W, 3) uint8, of the window's aspect.

        version: changes with the model, because an image and its render are kept while a slider moves.
        """
        camera = self.compared(settings, pose)
        if camera is None:
            scale = min(1.0, LONGEST / max(pose.width, pose.height)) / (COARSE if coarse else 1)
            width, height = (max(1, round(side * scale)) for side in (pose.width, pose.height))
            view = free_view(width, height, pose.fov, pose.position, pose.wxyz, self._gaussians.get_xyz.device)
            return to_bytes(self._image(settings, view)).numpy()
        key = replace(settings, slider=0, comparison=views.ALONE), version
        if self._compared[0] != key:
            target = as_float(camera.target(self._background(settings)))
            self._compared = key, (target, self._image(settings, camera, target))
        return to_bytes(_fitted(_composed(settings, *self._compared[1]), pose)).numpy()

    def compared(self, settings: Settings, pose: Pose) -> Camera | None:
        """The scene's camera whose target this frame shows, None: no target."""
        camera = self._cameras.by_name.get(settings.camera)
        requested = camera is not None and (settings.comparison != views.ALONE or settings.mode == views.ERROR)
        return camera if requested and self._cameras.stands_at(pose, camera) else None

    def _background(self, settings: Settings) -> Tensor:
        return self._gaussians.get_xyz.new_tensor(settings.background)

    def _image(self, settings: Settings, view: Camera | MiniCam, target: Tensor | None = None) -> Tensor:
        """The mode's image (3, H, W) in [0, 1]. Without a target there is no error, and the colour is drawn."""
        part = shown_part(self._gaussians, settings)
        if settings.mode == views.COUNT:
            return count_colors(blend_depth(view, part, self._pipe, settings.scaling))
        if settings.mode in (views.DEPTH, views.OPACITY):
            planes = view_planes(view, part, self._pipe, settings.scaling)
            depth, alpha = planes["depth"], planes["alpha"]
            return depth_colors(depth, alpha) if settings.mode == views.DEPTH else alpha.expand(3, -1, -1)
        exposed = self._with_exposures and target is not None
        options = {"want_depth": False, "want_visibility": False, "use_trained_exp": exposed}
        colour = render(view, part, self._pipe, self._background(settings), settings.scaling, **options)["render"]
        return error_image(target, colour) if settings.mode == views.ERROR and target is not None else colour


def _composed(settings: Settings, target: Tensor, image: Tensor) -> Tensor:
    if settings.comparison == views.ALONE:
        return image
    if settings.comparison == views.BESIDE:
        panels = [target, image]
        if settings.mode == views.COLOUR:
            panels.append(error_image(target, image))
        return torch.cat(panels, dim=2)
    width = target.shape[2]
    column = round(min(max(settings.slider, 0.0), 1.0) * width)
    composed = torch.cat([target[:, :, :column], image[:, :, column:]], dim=2)
    if 0 < column < width:
        composed[:, :, max(0, column - _LINE // 2) : column + _LINE // 2] = 1.0
    return composed


def _fitted(image: Tensor, pose: Pose) -> Tensor:
    """The image in the middle of a canvas of the window's aspect, not larger than LONGEST."""
    shrink = max(image.shape[1:]) / LONGEST
    if shrink > 1:
        size = [max(1, round(side / shrink)) for side in image.shape[1:]]
        image = torch.nn.functional.interpolate(image[None], size, mode="area")[0]
    height, width = image.shape[1:]
    wide, high = canvas(width, height, pose.width / pose.height)
    fitted = image.new_full((3, high, wide), _BORDER)
    top, left = (high - height) // 2, (wide - width) // 2
    fitted[:, top : top + height, left : left + width] = image
    return fitted


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


def colored(values: Tensor) -> Tensor:
    """Colours (3, H, W) of values (H, W) in [0, 1], linear between the stops; others are clamped."""
    stops = torch.tensor(_STOPS, dtype=values.dtype, device=values.device)
    place = values.clamp(0, 1) * (len(_STOPS) - 1)
    below = place.long().clamp_max(len(_STOPS) - 2)
    return torch.lerp(stops[below], stops[below + 1], (place - below)[..., None]).permute(2, 0, 1)


def depth_colors(depth: Tensor, alpha: Tensor) -> Tensor:
    """Colours (3, H, W) of the planes of `view_planes`, (1, H, W) each; depth is inverse: near is bright.

    Where less than half of a pixel is covered there is no depth, and the colour is black.
    """
    there = alpha[0] >= 0.5
    values = depth[0] / alpha[0].clamp_min(1e-6)
    known = values[there]
    if not len(known):
        return torch.zeros_like(alpha).expand(3, -1, -1)
    known = known[:: max(1, len(known) // _SAMPLE)]
    far, near = torch.quantile(known, torch.tensor([_FEW, _MOST], dtype=known.dtype, device=known.device))
    return torch.where(there, colored((values - far) / (near - far).clamp_min(1e-9)), 0.0)


def count_colors(counts: Tensor) -> Tensor:
    """Colours (3, H, W) of counts (H, W): linear, the largest of the image is the brightest."""
    return colored(counts.float() / counts.max().clamp_min(1))


def error_image(target: Tensor, render: Tensor) -> Tensor:
    """The difference (3, H, W) of two images in [0, 1], times ERROR_GAIN."""
    return ((target - render).abs() * ERROR_GAIN).clamp(0, 1)
