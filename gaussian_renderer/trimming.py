"""Removal of what a finished model does not need: Gaussians that no training view depends on, needless SH bands."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import decisive_for
from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.sh_bands import cut_bounds, needed_degree


@dataclass
class Trimmed:
    """A model without what it does not need, and a record of what was removed."""

    gaussians: GaussianModel
    unseen: int  # Gaussians left out
    cut_bounds: list[float]  # by degree: bound on a colour's change if all SH bands above the degree are cut
    seconds: float  # that the search took


def decisive_for_any(cameras: Sequence[Camera], gaussians: GaussianModel, pipe: argparse.Namespace) -> Tensor:
    """(N,) bool: the Gaussians that the image of any camera, at its size, depends on; all if there is none."""
    found = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.get_xyz.device)
    for camera in tqdm(cameras, desc="Looking for unseen Gaussians", unit="view", leave=False):
        found |= decisive_for(camera, gaussians, pipe)
    return found if found.any() else ~found  # never an empty model


def trim(
    gaussians: GaussianModel, cameras: Sequence[Camera], pipe: argparse.Namespace, keep_unseen: bool, prune_sh: float
) -> Trimmed:
    """Leave out what the training views `cameras` do not need. `gaussians` itself does not change.

    keep_unseen: leave no Gaussian out. prune_sh: by how much cut SH bands may change a colour (in [0, 1]); -1 cuts
    none. Unless bands are cut, the renders of `cameras` keep every bit.
    """
    start = time.perf_counter()
    keep = None if keep_unseen else decisive_for_any(cameras, gaussians, pipe)
    unseen = 0 if keep is None else int((~keep).sum())
    rest = gaussians.get_features_rest.detach()
    bounds = cut_bounds(rest[keep] if unseen else rest)
    degree = gaussians.max_sh_degree if prune_sh < 0 else needed_degree(bounds, prune_sh)
    if unseen or degree < gaussians.max_sh_degree:
        gaussians = gaussians.part(keep if unseen else slice(None), degree)
    return Trimmed(gaussians, unseen, bounds, time.perf_counter() - start)


@torch.no_grad()
def change_on_views(
    before: GaussianModel,
    after: GaussianModel,
    cameras: Sequence[Camera],
    views: ScoredViews,
    scored: bool,
) -> dict[str, float]:
    """Difference between the renders of two models: `largest`, of a value in [0, 1].

    scored: also `psnr_before` and `psnr_after`, dB.
    """
    change = {"largest": max(float((views.image(c, before) - views.image(c, after)).abs().max()) for c in cameras)}
    if scored:
        for name, model in (("psnr_before", before), ("psnr_after", after)):
            scores = views.scores(cameras, model)
            change |= {name: scores["psnr"]} if scores else {}
    return change
