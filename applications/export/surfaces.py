"""The surfaces that training views see: each view's depth and colours, rendered whenever they are asked for."""

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer.camera_paths.poses import keyframe, poses_of, vertical_fov
from gaussian_renderer.free_view import free_view
from gaussian_renderer.median_depth import Surface, surface_of
from groundwork.host.progress import Bar
from scene.cameras import Camera, MiniCam
from scene.splats.splats import Splats
from scene.with_splats import model_of
from utils.system_utils import UserError

_FAR = 4.0  # median depths beyond which surfaces are left out
_TRIED = 16  # views that the median depth is of


class Surfaces:
    """The surfaces of splats in views. pixel: the height of a pixel at the median depth, in the world's unit."""

    def __init__(self, splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace) -> None:
        """UserError if there is no camera, or none sees a surface."""
        self._gaussians = model_of(splats)
        self._pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": splats.antialiasing}))
        self.views = make_pinholes(cameras)
        if not self.views:
            raise UserError("a mesh needs training cameras, from which it sees the surfaces; the scene has none")
        tried = self.views[:: -(-len(self.views) // _TRIED)]
        spans = [_measure_pixel(view, self._render_surface(view).depth) for view in tried]
        if not any(spans):
            raise UserError("a mesh needs surfaces, and no training view shows anything opaque; train for longer")
        depth, self.pixel = np.median([span for span in spans if span], axis=0).tolist()
        self._far = _FAR * depth

    @property
    def device(self) -> torch.device:
        return self._gaussians.get_xyz.device

    def each(self, what: str) -> Iterator[tuple[Camera | MiniCam, Surface]]:
        """Each view with its surface, whose depth is 0 beyond _FAR. what: for the progress bar."""
        for view in Bar(self.views, desc=what, unit="view"):
            depth, color = self._render_surface(view)
            yield view, Surface(torch.where(depth < self._far, depth, 0), color)

    def _render_surface(self, view: Camera | MiniCam) -> Surface:
        return surface_of(view, self._gaussians, self._pipe)


def make_pinholes(cameras: Sequence[Camera]) -> list[Camera | MiniCam]:
    """Replace views with lenses by pinhole views at their places, as wide as those are high, or 60 degrees."""
    views = []
    for camera, poses in ((camera, poses_of([camera])) for camera in cameras):
        if getattr(camera, "lens", None) is not None:
            pose = keyframe(0.0, poses.positions[0], poses.turns[0], 0.0)
            size = camera.image_width, camera.image_height
            camera = free_view(*size, vertical_fov(camera), pose.position, pose.wxyz, camera.device)
        views.append(camera)
    return views


def _measure_pixel(view: Camera | MiniCam, depth: Tensor) -> tuple[float, float] | None:
    """The median depth of a view, and the height of a pixel there; None of an empty one."""
    known = depth[depth > 0]
    if not len(known):
        return None
    median = float(known.median())
    return median, median * 2 * float(np.tan(view.FoVy / 2)) / view.image_height
