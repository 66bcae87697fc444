"""Scores of held-out views as their photos show them."""

import argparse

import torch
from torch import Tensor

from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from splatting.parts.ppisp.appearance import PhotoAppearance
from utils.image_utils import as_float, half


def fitted_views(photos: PhotoAppearance, pipe: argparse.Namespace, background: Tensor) -> ScoredViews:
    """Right halves of held-out views, with their photos' exposure and balance from the left ones.

    The trained numbers stay as they are (the protocol of Martin-Brualla et al. 2021, NeRF in the Wild).
    """

    def draw(camera: Camera, gaussians: GaussianModel) -> Tensor:
        options = {"want_depth": False, "want_visibility": False, "clamp": False}
        image = render(camera, gaussians, pipe, background, **options)["render"]
        target, mask = camera.ground_truth(background)
        counts = torch.zeros_like(image[:1], dtype=torch.bool)
        counts[..., half(image.shape[-1], of_test_view=False)] = True
        counts = counts if mask is None else counts & mask
        return photos.fitted(image, as_float(target), counts, camera.colmap_id)

    return ScoredViews(pipe, background, True, draw)
