"""Renders of views and their ground truth, as scores compare them."""

import argparse

from torch import Tensor

from gaussian_renderer import render
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.image_utils import right_half


class ScoredViews:
    """Images of views and what they should be, as they are scored: by the half-image protocol (train_test_exp) the
    right halves alone, rendered with exposures."""

    def __init__(self, pipe: argparse.Namespace, background: Tensor, train_test_exp: bool) -> None:
        self._pipe = pipe
        self._background = background
        self._halves = train_test_exp

    def image(self, camera: Camera, gaussians: GaussianModel) -> Tensor:
        """Render (3, H, W) float32 in [0, 1]."""
        exposed = {"use_trained_exp": self._halves}
        package = render(camera, gaussians, self._pipe, self._background, **exposed, want_visibility=False)
        return self._part(package["render"])

    def target(self, camera: Camera) -> Tensor:
        """What the render should be, as `Camera.target`."""
        return self._part(camera.target(self._background))

    def mask(self, camera: Camera) -> Tensor | None:
        """Which pixels count, (1, H, W) bool; None where all do."""
        mask = camera.mask
        return None if mask is None else self._part(mask)

    def _part(self, image: Tensor) -> Tensor:
        return right_half(image).contiguous() if self._halves else image
