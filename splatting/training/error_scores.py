"""Scores of Gaussians: how much of the error of training views each of them draws (Rota Bulo et al. 2024)."""

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_renderer.weighted_sums import weighted_sums
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.exposure import apply_exposure
from splatting.training.error_maps import error_map


class ErrorScores:
    """Scores Gaussians by views, as the loss of training sees them: exposure, mask, columns that count, and no clamp.

    exposures: whether the photos' exposures are trained. opt: score_error is the kind of error (`error_map`), with
    lambda_dssim; score_join is "sum" or "max".
    """

    def __init__(
        self, gaussians: GaussianModel, pipe: argparse.Namespace, exposures: bool, opt: argparse.Namespace
    ) -> None:
        self._gaussians, self._pipe, self._exposures, self._opt = gaussians, pipe, exposures, opt

    def of_views(self, cameras: Sequence[Camera], background: Tensor) -> Tensor:
        """`of_view` of several views, joined to one score: (N,) float64."""
        total = torch.zeros(len(self._gaussians), dtype=torch.float64, device=background.device)
        for camera in cameras:
            score = self.of_view(camera, background)
            total = torch.maximum(total, score) if self._opt.score_join == "max" else total + score
        return total

    def of_view(self, camera: Camera, background: Tensor) -> Tensor:
        """Sum over the pixels of the error times each Gaussian's blending weight: (N,) float64."""

        def three_times(image: Tensor) -> Tensor:
            return self._error_of(image, camera, background).expand(3, -1, -1).contiguous()

        sums = weighted_sums(camera, self._gaussians, self._pipe, background, three_times)
        return sums[:, 0].to(torch.float64)

    def _error_of(self, image: Tensor, camera: Camera, background: Tensor) -> Tensor:
        """The error (1, H, W) of a render of the view, (3, H, W) before exposure."""
        target, mask = camera.ground_truth(background)
        if self._exposures and (name := camera.exposure_name or camera.image_name) is not None:
            image = apply_exposure(image, self._gaussians.get_exposure_from_name(name))
        return error_map(self._opt.score_error, image, target, self._opt.lambda_dssim, mask, camera.columns)
