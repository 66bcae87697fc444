"""Cleaning: leave out Gaussians that the photos speak against, then those that add least to the training views.

Leaving a Gaussian out changes a view's squared error by about minus the opacity times the derivative of the error by
the opacity (Molchanov et al. 2017, "Pruning convolutional neural networks for resource efficient inference"). Where the
sum over the views is negative, the photos speak against the Gaussian, as they do for floaters. All other Gaussians are
ordered by their share of a view's blending weights. Both are divided by the view's error, because a view with a small
error is the first to lose dB.
"""

import argparse
import math
import os
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from applications.export.importance import change_without
from gaussian_renderer.blending import weighted_sums
from gaussian_renderer.camera_paths.without_scene import WithoutScene
from gaussian_renderer.free_view import FRACTIONS, neighbours, views_between
from gaussian_renderer.scored_views import ScoredViews
from groundwork.files.image_files import to_bytes
from groundwork.files.ours import write_picture
from groundwork.host.progress import Bar
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from splatting.records.renders import WIDEST, sheet
from utils.image_utils import as_float, pixels_that_count
from utils.system_utils import UserError, compute_device

OPTION = {"type": float, "nargs": "?", "const": 0.05, "metavar": "DB"}  # --clean, as argparse takes it
_STEPS = 1000  # a search ends within N / _STEPS of the most that may go
_EXACT = 1e-12  # least squared error of a view
_TOGETHER = 8  # most views that are scored before a GPU is waited for
_SHOWN = 3  # views of the picture


class Cleaning:
    """A model from which Gaussians are left out, as long as no view loses more than `most` dB of its best PSNR.

    keep: Gaussians that stay, (N,) bool.
    before, after: PSNR by view, dB.
    """

    def __init__(self, gaussians: GaussianModel, cameras: Sequence[Camera], views: ScoredViews, most: float) -> None:
        """Score the whole model.

        most: dB of its best PSNR that a view may lose.
        """
        self._gaussians, self._cameras, self._views, self._most = gaussians, list(cameras), views, most
        self.keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.get_xyz.device)
        scores = self._measure_psnrs(self._cameras, gaussians)
        self.before = {id(camera): psnr for camera, psnr in zip(self._cameras, scores, strict=True)}
        self.after = dict(self.before)
        self._best = dict(self.before)

    def _make_part(self, keep: Tensor) -> GaussianModel:
        return self._gaussians.part(keep, self._gaussians.max_sh_degree)

    def _measure_psnrs(self, cameras: Sequence[Camera], gaussians: GaussianModel) -> list[float]:
        """PSNR of each view, dB, infinite where no pixel counts. A GPU is waited for once."""
        return torch.stack([-10.0 * self._measure_error(camera, gaussians).log10() for camera in cameras]).tolist()

    def _measure_error(self, camera: Camera, gaussians: GaussianModel) -> Tensor:
        """Mean squared error of a view, 0 where no pixel counts."""
        image, target, mask = self._views.compared(camera, gaussians)
        return pixels_that_count(image - as_float(target), mask).square().mean()

    def _score_part(self, keep: Tensor) -> dict[int, float] | None:
        """Return the PSNR by view of a part of the model; None if a view loses too much.

        That view is scored first from then on.
        """
        gaussians, found = self._make_part(keep), {}
        while len(found) < len(self._cameras):
            # The first ones fail most often, so they are waited for one by one.
            some = self._cameras[len(found) :][: min(max(len(found), 1), _TOGETHER)]
            for camera, psnr in zip(some, self._measure_psnrs(some, gaussians), strict=True):
                found[id(camera)] = psnr
                if self._best[id(camera)] - psnr > self._most:
                    self._cameras.remove(camera)
                    self._cameras.insert(0, camera)
                    return None
        return found

    def leave_out(self, order: Tensor) -> None:
        """Leave out as many Gaussians as possible from the start of a list, by bisection.

        order: (n,) indices.
        """
        low, high, scores = 0, len(order) + 1, None
        with Bar(desc="Trying what may go", unit="try", leave=False) as bar:
            while high - low > max(1, len(self._gaussians) // _STEPS):
                middle = (low + high) // 2
                keep = self.keep.clone()
                keep[order[:middle]] = False
                tried = self._score_part(keep) if keep.any() else None
                low, high, scores = (middle, high, tried) if tried else (low, middle, scores)
                bar.update()
        if scores:
            self.keep[order[:low]] = False
            self.after = scores
            self._best = {view: max(score, scores[view]) for view, score in self._best.items()}

    def changes(self) -> Tensor:
        """Return by how much the views' errors change without each Gaussian, relative to these errors: (N,) float64."""
        gaussians = self._make_part(self.keep)
        found = gaussians.get_xyz.new_zeros(len(gaussians), dtype=torch.float64)
        for camera in Bar(self._cameras, desc="Asking the photos", unit="view", leave=False):
            mask = self._views.mask(camera)
            if mask is not None and not mask.any():
                continue
            with torch.enable_grad():
                error = self._measure_error(camera, gaussians)
                found += change_without(error, gaussians) / error.detach().double().clamp_min(_EXACT)
        return self._spread(found)

    def added(self) -> Tensor:
        """Return the largest share that each Gaussian has in a view: (N,) float64.

        The share is the sum of the Gaussian's blending weights, divided by the view's pixels and by its error. The
        views are the training views, and views between neighbours, which may show Gaussians that the photos do not.
        """
        gaussians = self._make_part(self.keep)
        found = gaussians.get_xyz.new_zeros(len(gaussians), dtype=torch.float64)
        errors = [max(10 ** (-self.after[id(camera)] / 10), _EXACT) for camera in self._cameras]
        pairs = neighbours(self._cameras, 0)
        between = chain.from_iterable(views_between(self._cameras[i], self._cameras[j]) for i, j in pairs)
        coarse = ((_halve_view(view), sum(errors) / len(errors)) for view in between)
        views = chain(zip(self._cameras, errors, strict=True), coarse)
        count = len(errors) + len(FRACTIONS) * len(pairs)
        for camera, error in Bar(views, desc="Weighing Gaussians", total=count, unit="view", leave=False):
            black = gaussians.get_xyz.new_zeros(3)
            weights = weighted_sums(camera, gaussians, self._views.pipe, black, torch.ones_like)[:, 0].double()
            weights /= error * camera.image_width * camera.image_height
            found = torch.maximum(found, weights)
        return self._spread(found)

    def _spread(self, values: Tensor) -> Tensor:
        """Values (n,) of the Gaussians that stay as those of all (N,): zero for the others, and where not a number."""
        every = torch.zeros_like(self.keep, dtype=values.dtype)
        every[self.keep] = values
        return every.nan_to_num(0.0)


def _halve_view(view: MiniCam) -> MiniCam:
    """Halve width and height of a view: a quarter of the work, with about the same shares of the image."""
    view.image_width, view.image_height = (max(1, size // 2) for size in (view.image_width, view.image_height))
    return view


@torch.no_grad()
def clean(gaussians: GaussianModel, cameras: Sequence[Camera], views: ScoredViews, most: float) -> Cleaning:
    """Leave Gaussians out of a model, so that no view's PSNR falls by more than `most` dB.

    The model itself does not change. A view that has gained PSNR on the way may not lose more than `most` of its best
    one.
    """
    cleaning = Cleaning(gaussians, cameras, views, most)
    changes = cleaning.changes()
    order = torch.argsort(changes, stable=True)
    cleaning.leave_out(order[(changes < 0)[order]])
    order = torch.argsort(cleaning.added(), stable=True)
    cleaning.leave_out(order[cleaning.keep[order]])
    return cleaning


def check_clean(most: float | None) -> None:
    """Raise UserError for a number that --clean does not take."""
    if most is not None and not 0 < most < math.inf:
        raise UserError(f"--clean must be above 0 dB, got {most}")


def clean_scene(
    scene: Scene | WithoutScene, most: float, pipe: argparse.Namespace, white: bool
) -> tuple[Cleaning, ScoredViews]:
    """Clean a scene's model, and print how many Gaussians go and what the training views lose.

    UserError if the scene has no training views.
    """
    cameras, background = scene.getTrainCameras(), torch.full((3,), float(white))
    if not cameras:
        raise UserError("--clean needs training views, and the scene has none; leave it out")
    views = ScoredViews(pipe, background.to(compute_device()), scene.halves)
    cleaning = clean(scene.gaussians, cameras, views, most)
    loss = {camera.image_name: cleaning.before[id(camera)] - cleaning.after[id(camera)] for camera in cameras}
    finite = {name: value for name, value in loss.items() if math.isfinite(value)} or {cameras[0].image_name: 0.0}
    worst, mean = max(finite, key=finite.get), sum(finite.values()) / len(finite)
    gone, total = int((~cleaning.keep).sum()), len(cleaning.keep)
    print(
        f"--clean {most:g}: {gone:,} of {total:,} Gaussians go ({100 * gone / total:.1f} %); training views change by "
        f"{-mean:+.3f} dB in the mean, and {worst} most, by {-finite[worst]:+.3f} dB"
    )
    return cleaning, views


@torch.no_grad()
def write_comparison(
    path: str | os.PathLike, gaussians: GaussianModel, keep: Tensor, cameras: Sequence[Camera], views: ScoredViews
) -> None:
    """Write a PNG of the views that change most, with a row for each view: before, gone, after."""
    degree = gaussians.max_sh_degree
    gone, after = gaussians.part(~keep, degree), gaussians.part(keep, degree)
    changes = torch.stack(
        [(views.image(c, gaussians) - views.image(c, after)).square().mean() for c in cameras]
    ).tolist()
    chosen = sorted(range(len(cameras)), key=lambda k: -changes[k])[:_SHOWN]
    rows = [
        [(name, Image.fromarray(to_bytes(views.image(cameras[k], model)).numpy())) for name, model in
         ((str(cameras[k].image_name), gaussians), ("", gone), ("", after))]
        for k in chosen
    ]  # fmt: skip
    write_picture(Path(path), sheet(("before", "gone", "after"), rows, WIDEST))
