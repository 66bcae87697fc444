"""Scores of Gaussians: how much of the error of training views each of them draws (Rota Bulo et al. 2024, section 3)."""

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_renderer.weighted_sums import weighted_sums
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.exposure import apply_exposure
from training.error_maps import error_map


class ErrorScores:
    """Scores Gaussians by views, as the loss of training sees them: exposure, clamp, mask and columns that count.

    error: name of the error of a pixel (training/error_maps.py). exposures: whether the photos' exposures are trained.
    """

    def __init__(self, gaussians: GaussianModel, pipe: argparse.Namespace, exposures: bool, error: str) -> None:
        self._gaussians, self._pipe, self._exposures = gaussians, pipe, exposures
        self._error = error

    def of_views(self, cameras: Sequence[Camera], background: Tensor, join: str) -> Tensor:
        """`of_view` of several views, joined by "sum" or "max": (N,) float64."""
        total = torch.zeros(len(self._gaussians), dtype=torch.float64, device=background.device)
        for camera in cameras:
            score = self.of_view(camera, background)
            total = torch.maximum(total, score) if join == "max" else total + score
        return total

    def of_view(self, camera: Camera, background: Tensor) -> Tensor:
        """Sum over the pixels of the error times each Gaussian's blending weight: (N,) float64."""

        def three_times(image: Tensor) -> Tensor:
            return self._error_of(image, camera, background).expand(3, -1, -1).contiguous()

        sums = weighted_sums(camera, self._gaussians, self._pipe, background, three_times)
        return sums[:, 0].to(torch.float64)

    def _error_of(self, image: Tensor, camera: Camera, background: Tensor) -> Tensor:
        """The error (1, H, W) of a render of the view, (3, H, W) before exposure and clamp."""
        target, mask = camera.ground_truth(background)
        if self._exposures and (name := camera.exposure_name or camera.image_name) is not None:
            image = apply_exposure(image, self._gaussians.get_exposure_from_name(name))
        return error_map(self._error, image, target, mask, camera.columns)
