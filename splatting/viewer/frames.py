"""The image of a frame: what the settings ask for, from a pose."""

import argparse
import copy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer import render
from gaussian_renderer.free_view import free_view
from gaussian_renderer.view_planes import blend_depth, view_planes
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from splatting.viewer import colormaps
from splatting.viewer.scene_cameras import SceneCameras, canvas
from splatting.viewer.settings import (
    ALONE,
    BESIDE,
    COLOUR,
    COUNT,
    DEPTH,
    ERROR,
    OPACITY,
    Pose,
    Settings,
    Vector,
)
from utils.image_utils import as_float

LONGEST = 1600  # pixels of a frame's longer side, at most
COARSE = 2  # a frame of a moving camera has a quarter of the pixels
_BORDER = 0.15  # grey around a photo that does not fill the window
_LINE = 2  # pixels of the slider's line


class Frames:
    """Draws frames of a model. with_exposures: as `use_trained_exp` of `render`, for an image beside its photo.

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

        version: changes with the model, because a photo and its render are kept while a slider moves.
        """
        camera = self.compared(settings, pose)
        if camera is None:
            return _bytes(self._free(settings, pose, coarse))
        key = replace(settings, slider=0, comparison=ALONE), version
        if self._compared[0] != key:
            self._compared = key, self._pair(settings, camera)
        return _bytes(_fitted(_composed(settings, *self._compared[1]), pose))

    def compared(self, settings: Settings, pose: Pose) -> Camera | None:
        """The scene's camera whose photo this frame shows, None: no photo."""
        camera = self._cameras.by_name.get(settings.camera)
        wanted = camera is not None and (settings.comparison != ALONE or settings.mode == ERROR)
        return camera if wanted and self._cameras.stands_at(pose, camera) else None

    def _free(self, settings: Settings, pose: Pose, coarse: bool) -> Tensor:
        scale = min(1.0, LONGEST / max(pose.width, pose.height)) / (COARSE if coarse else 1)
        width, height = (max(1, round(side * scale)) for side in (pose.width, pose.height))
        view = free_view(width, height, pose.fov, pose.position, pose.wxyz, self._gaussians.get_xyz.device)
        return self._image(settings, view)

    def _pair(self, settings: Settings, camera: Camera) -> tuple[Tensor, Tensor]:
        """The photo and the image beside it, (3, H, W) in [0, 1]."""
        photo = as_float(camera.target(self._background(settings)))
        return photo, self._image(settings, camera, photo)

    def _background(self, settings: Settings) -> Tensor:
        return self._gaussians.get_xyz.new_tensor(settings.background)

    def _image(self, settings: Settings, view: Camera | MiniCam, photo: Tensor | None = None) -> Tensor:
        """The mode's image (3, H, W) in [0, 1]. Without a photo there is no error, and the colour is drawn."""
        part = shown_part(self._gaussians, settings)
        if settings.mode == COUNT:
            return colormaps.count_colors(blend_depth(view, part, self._pipe, settings.scaling))
        if settings.mode in (DEPTH, OPACITY):
            planes = view_planes(view, part, self._pipe, settings.scaling)
            return colormaps.depth_colors(**planes) if settings.mode == DEPTH else planes["alpha"].expand(3, -1, -1)
        exposed = self._with_exposures and photo is not None
        options = {"want_depth": False, "want_visibility": False, "use_trained_exp": exposed}
        colour = render(view, part, self._pipe, self._background(settings), settings.scaling, **options)["render"]
        return colormaps.error_image(photo, colour) if settings.mode == ERROR and photo is not None else colour


def _composed(settings: Settings, photo: Tensor, image: Tensor) -> Tensor:
    if settings.comparison == ALONE:
        return image
    if settings.comparison == BESIDE:
        panels = [photo, image]
        if settings.mode == COLOUR:
            panels.append(colormaps.error_image(photo, image))
        return torch.cat(panels, dim=2)
    width = photo.shape[2]
    column = round(min(max(settings.slider, 0.0), 1.0) * width)
    composed = torch.cat([photo[:, :, :column], image[:, :, column:]], dim=2)
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


def _bytes(image: Tensor) -> np.ndarray:
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()


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
