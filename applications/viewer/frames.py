"""The image of a frame: what the settings ask for, from a pose."""

import argparse
import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from applications.viewer import views
from applications.viewer.coverage import Coverage, darken_guesses
from applications.viewer.legend import ERROR_SCALE, Legend, color_counts, color_depth, draw_error
from applications.viewer.views import Pose, SceneCameras, Settings, Vector, fit_canvas
from gaussian_renderer import render
from gaussian_renderer.blending import count_list_entries, view_planes
from gaussian_renderer.free_view import free_view, rotation_matrix
from gaussian_renderer.median_depth import median_at
from groundwork.files.image_files import dim_masked, to_bytes
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from utils.image_utils import as_float

LONGEST = 1600  # pixels of a frame's longer side, at most
COARSE = 2  # a frame of a moving camera has a quarter of the pixels
_BORDER = 0.15  # grey around a target that does not fill the window
_NO_PHOTO = "No photo was taken from here. “Go to the camera” (tab Photos) leads to one."


class Frame(NamedTuple):
    """image: (H, W, 3) uint8. legend: what its colours mean, or what it lacks."""

    image: np.ndarray
    legend: Legend


class Frames:
    """Draws frames of a model, in one thread. Nothing of the model changes.

    kept: (N,) bool, Gaussians that cleaning leaves; None: nobody asked.
    coverage: of the training views; None: not known.
    """

    def __init__(
        self, gaussians: GaussianModel, cameras: SceneCameras, pipe: argparse.Namespace, with_exposures: bool
    ) -> None:
        """Prepare to draw frames of a model.

        cameras: of the scene, whose photos frames are compared with.
        with_exposures: true to draw an image beside its target with the trained exposure.
        """
        self.gaussians = gaussians
        self._cameras = cameras
        self._pipe = pipe
        self._with_exposures = with_exposures
        self.kept: Tensor | None = None
        self.coverage: Coverage | None = None
        self.masks: Callable[[Camera], Tensor | None] = lambda _: None  # pixels of a photo that train, None: all
        self._compared: tuple[object, tuple[Tensor, Tensor, Legend]] = (None, ())

    @torch.no_grad()
    def draw(self, settings: Settings, pose: Pose, coarse: bool, version: int = 0) -> Frame:
        """A frame of the window's aspect.

        version: changes with the model, because an image and its render are kept while a slider moves.
        """
        camera = self.compared(settings, pose)
        if camera is None:
            width, height = _choose_size(pose, COARSE if coarse else 1)
            view = free_view(width, height, pose.fov, pose.position, pose.wxyz, self.gaussians.get_xyz.device)
            image, words = self._draw_image(settings, view)
            return Frame(to_bytes(image).numpy(), words._replace(warning=_NO_PHOTO if _needs_photo(settings) else ""))
        key = replace(settings, slider=0, comparison=views.ALONE), version
        if self._compared[0] != key:
            target = as_float(camera.target(self._make_background(settings)))
            drawn = self._draw_image(settings, camera, target)
            if (counts := self.masks(camera)) is not None:
                target = dim_masked(target, counts)
            self._compared = key, (target, *drawn)
        target, image, words = self._compared[1]
        if settings.comparison == views.BESIDE and settings.mode == views.COLOUR:
            words = ERROR_SCALE  # of the third image
        shown = to_bytes(_fit_window(_compose_panels(settings, target, image), pose)).numpy()
        return Frame(shown, words._replace(sides=_describe_sides(settings)))

    def surface(self, settings: Settings, pose: Pose, ray: np.ndarray) -> np.ndarray | None:
        """The point (3,) of the surface along a ray (3,) of a pose's window; None where there is none.

        Its depth is the median in the pixel that the ray goes through.
        """
        axes, place = rotation_matrix(pose.wxyz), np.array(pose.position)
        width, height = _choose_size(pose)
        right, down, ahead = ray @ axes
        if ahead <= 0:
            return None
        focal = height / 2 / math.tan(pose.fov / 2)
        column, row = round((width - 1) / 2 + focal * right / ahead), round((height - 1) / 2 + focal * down / ahead)
        view = free_view(width, height, pose.fov, pose.position, pose.wxyz, self.gaussians.get_xyz.device)
        part = select_shown(self.gaussians, settings, self.kept)
        depth = median_at(view, part, self._pipe, min(max(column, 0), width - 1), min(max(row, 0), height - 1))
        return place + depth / ahead * ray if depth else None

    def compared(self, settings: Settings, pose: Pose) -> Camera | None:
        """The scene's camera whose target this frame shows, None: no target."""
        camera = self._cameras.by_name.get(settings.camera)
        return camera if camera and _needs_photo(settings) and self._cameras.stands_at_camera(pose, camera) else None

    def _make_background(self, settings: Settings) -> Tensor:
        return self.gaussians.get_xyz.new_tensor(settings.background)

    def _draw_image(
        self, settings: Settings, view: Camera | MiniCam, target: Tensor | None = None
    ) -> tuple[Tensor, Legend]:
        """The mode's image (3, H, W) in [0, 1]. Without a target there is no error, and the colour is drawn."""
        part = select_shown(self.gaussians, settings, self.kept)
        if settings.mode == views.COUNT:
            return color_counts(count_list_entries(view, part, self._pipe, settings.scaling))
        if settings.mode in (views.DEPTH, views.OPACITY):
            planes = view_planes(view, part, self._pipe, settings.scaling)
            if settings.mode == views.DEPTH:
                return color_depth(planes["depth"], planes["alpha"])
            return planes["alpha"].expand(3, -1, -1), Legend()
        exposed = self._with_exposures and target is not None
        coverage = self.coverage if settings.darken and target is None else None
        options = {"want_depth": False, "want_visibility": False, "use_trained_exp": exposed}
        if coverage is not None:
            options["features"] = coverage.guesses(part.get_xyz, view.camera_center)
        drawn = render(view, part, self._pipe, self._make_background(settings), settings.scaling, **options)
        colour = drawn["render"]
        if coverage is not None:
            return darken_guesses(colour, drawn["features"]), Legend()
        if settings.mode == views.ERROR and target is not None:
            return draw_error(target, colour), ERROR_SCALE
        return colour, Legend()


def _choose_size(pose: Pose, coarser: int = 1) -> tuple[int, int]:
    """The width and height of a frame, in pixels."""
    scale = min(1.0, LONGEST / max(pose.width, pose.height)) / coarser
    return max(1, round(pose.width * scale)), max(1, round(pose.height * scale))


def _needs_photo(settings: Settings) -> bool:
    return settings.comparison != views.ALONE or settings.mode == views.ERROR


def _describe_sides(settings: Settings) -> str:
    """Say which image is where in the frame of `_compose_panels`."""
    shown = "render" if settings.mode == views.COLOUR else settings.mode.lower()
    error = ", error" if settings.mode == views.COLOUR else ""
    sides = {
        views.SLIDER: f"Photo left of the line, {shown} right",
        views.BESIDE: f"From the left: photo, {shown}{error}",
    }
    return sides.get(settings.comparison, "")


def _compose_panels(settings: Settings, target: Tensor, image: Tensor) -> Tensor:
    """Put the photo and the render into one frame, (3, H, W) each: side by side, or on either side of the slider."""
    if settings.comparison == views.ALONE:
        return image
    if settings.comparison == views.BESIDE:
        panels = [target, image]
        if settings.mode == views.COLOUR:
            panels.append(draw_error(target, image))
        return torch.cat(panels, dim=2)
    width = target.shape[2]
    column = round(min(max(settings.slider, 0.0), 1.0) * width)
    return torch.cat([target[:, :, :column], image[:, :, column:]], dim=2)


def _fit_window(image: Tensor, pose: Pose) -> Tensor:
    """The image in the middle of a canvas of the window's aspect, not larger than LONGEST."""
    aspect = pose.width / pose.height
    shrink = max(fit_canvas(image.shape[2], image.shape[1], aspect)) / LONGEST
    if shrink > 1:
        size = [max(1, round(side / shrink)) for side in image.shape[1:]]
        image = torch.nn.functional.interpolate(image[None], size, mode="area")[0]
    height, width = image.shape[1:]
    wide, high = fit_canvas(width, height, aspect)
    fitted = image.new_full((3, high, wide), _BORDER)
    top, left = (high - height) // 2, (wide - width) // 2
    fitted[:, top : top + height, left : left + width] = image
    return fitted


@torch.no_grad()
def select_shown(gaussians: GaussianModel, settings: Settings, kept: Tensor | None = None) -> GaussianModel:
    """The Gaussians in the crop box that cleaning keeps or leaves out, with the settings' SH degree at most."""
    degree = min(settings.sh_degree, gaussians.active_sh_degree)
    chosen = [] if settings.crop is None else [find_inside(gaussians.get_xyz, *settings.crop)]
    if kept is not None and settings.cleaning != views.WHOLE:
        chosen.append(kept if settings.cleaning == views.STAYS else ~kept)
    if chosen:
        part = gaussians.part(torch.stack(chosen).all(0), gaussians.max_sh_degree)
    elif degree == gaussians.active_sh_degree:
        return gaussians
    else:
        part = copy.copy(gaussians)  # shares the tensors
    part.active_sh_degree = degree
    return part


def find_inside(positions: Tensor, one: Vector, other: Vector) -> Tensor:
    """(N,) bool: which positions (N, 3) lie in the box with these opposite corners."""
    corners = positions.new_tensor([one, other])
    return ((positions >= corners.amin(0)) & (positions <= corners.amax(0))).all(1)
