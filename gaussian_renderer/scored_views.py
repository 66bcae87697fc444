"""Scores of views against their photos, with half images, exposures, masks and targets."""

import argparse
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from gaussian_renderer import photo_name, render
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.image_utils import as_float, half, mean_psnr, pixels_that_count
from utils.loss_utils import l1_and_ssim


class ScoredViews:
    """Renders of views and their targets, as they are scored.

    A view of a photo that the model's exposures cover is rendered with its exposure.

    pipe: the pipeline options.
    halves: only right halves count, rendered with exposures (the half-image protocol).
    draw: renders a camera and a model to (3, H, W) in [0, 1]; None: `render`.
    whole: the whole image of `draw`, before `part` cuts it.
    """

    def __init__(
        self,
        pipe: argparse.Namespace,
        background: Tensor,
        halves: bool,
        draw: Callable[[Camera, GaussianModel], Tensor] | None = None,
    ) -> None:
        """Keep how views are drawn. halves: scores are of right halves. draw: replaces the render of a whole view."""
        self.pipe = pipe
        self._background = background
        self.halves = halves
        self.whole = draw or self._render

    def _render(self, camera: Camera, gaussians: GaussianModel) -> Tensor:
        exposed = self.halves or has_trained_exposure(camera, gaussians)
        options = {"use_trained_exp": exposed, "want_depth": False, "want_visibility": False}
        return render(camera, gaussians, self.pipe, self._background, **options)["render"]

    def part(self, image: Tensor) -> Tensor:
        """The scored part of an image (C, H, W): all of it, or its right half."""
        return image[..., half(image.shape[-1], of_test_view=True)].contiguous() if self.halves else image

    def image(self, camera: Camera, gaussians: GaussianModel) -> Tensor:
        """The scored part of the render, (3, H, W) float32 in [0, 1]."""
        return self.part(self.whole(camera, gaussians))

    def target(self, camera: Camera) -> Tensor:
        """The scored part of `Camera.target`."""
        return self.part(camera.target(self._background))

    def mask(self, camera: Camera) -> Tensor | None:
        """Pixels that count, (1, H, W) bool; None if all do."""
        mask = camera.counted_pixels
        return None if mask is None else self.part(mask)

    def load(self, camera: Camera) -> None:
        """Decode the photo and the mask, so that a timed scoring does not have to."""
        self.target(camera)
        self.mask(camera)

    def compared(self, camera: Camera, gaussians: GaussianModel) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return render, target and mask for `mean_scores`."""
        return self.image(camera, gaussians), self.target(camera), self.mask(camera)

    def scores(self, cameras: Iterable[Camera], gaussians: GaussianModel) -> dict[str, float]:
        """Return `mean_scores` of views."""
        return mean_scores(self.compared(camera, gaussians) for camera in cameras)


def has_trained_exposure(camera: Camera, gaussians: GaussianModel) -> bool:
    """Tell whether a view's photo has a trained exposure that every render applies."""
    exposures = getattr(gaussians, "exposures", None)
    return exposures is not None and exposures.covers(photo_name(camera))


def extra_test_views(
    scene: Any, pipe: argparse.Namespace, background: Tensor
) -> dict[str, tuple[ScoredViews | None, list[Camera]]]:
    """Further test views that parts score, by suffix of the set's name: the scoring (None: the usual) and the views.

    A scene of other code has none.
    """
    parts = getattr(scene, "parts", ())
    return {name: views for part in parts for name, views in part.scored(scene, pipe, background).items()}


def mean_scores(compared: Iterable[tuple[Tensor, Tensor, Tensor | None]]) -> dict[str, float]:
    """Mean `l1`, `psnr` (dB) and `ssim` over tuples (render, target, mask); {} without any.

    render: (3, H, W) float32 in [0, 1].
    target: the same, or uint8 meaning value / 255.
    mask: (1, H, W) bool, the pixels that count, or None (utils/loss_utils.py); a view in which none counts is left out.

    PSNR comes from one mean squared error over pixels and channels of a pair. Equal pairs are left out of its mean, and
    without others there is no `psnr`. metrics.py scores the same views from 8-bit PNGs; the training report takes the
    mean of the three channels' PSNRs. Without masks, the function waits for a GPU once.
    """
    scores = []
    with torch.no_grad():
        for image, target, mask in compared:
            if mask is not None and not mask.any():
                continue
            l1, ssim = l1_and_ssim(image, target, mask)
            mse = pixels_that_count(image - as_float(target), mask).square().mean()
            scores.append(torch.stack([l1, -10.0 * mse.log10(), ssim]))
        columns = torch.stack(scores).double().T.tolist() if scores else []
    means = {name: mean_psnr(values) for name, values in zip(("l1", "psnr", "ssim"), columns, strict=False)}
    return {name: value for name, value in means.items() if value is not None}
