"""Removal of unseen Gaussians and needless SH bands from a finished model."""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from gaussian_renderer import decisive_for
from gaussian_renderer.free_view import FRACTIONS, NEAREST, neighbours, views_between
from gaussian_renderer.scored_views import ScoredViews
from groundwork.host.progress import Bar
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from scene.gaussians.sh_bands import cut_bounds, needed_degree

FAINT = -math.log(254) - 1e-4  # logit of opacity 1/255, below which no pixel draws a Gaussian, less some rounding
WORTH = 0.01  # share of the Gaussians; fewer unseen ones stay, because leaving them out saves little and is a risk
ITERATIONS_PER_VIEW = 15  # of training, for each view that the search may look at: some 4 % of the time

KEPT, TOO_LONG, FEW, DONE = "not wanted", "too long", "too few", "done"  # ends of a search


@dataclass
class Search:
    """The result of a search for unseen Gaussians, and of their removal."""

    keep: Tensor  # (N,) bool
    faint: int = 0  # Gaussians of an opacity below 1/255
    views: int = 0  # looked at; for TOO_LONG, those that it would have taken
    end: str = KEPT
    unseen: int = 0  # Gaussians left out, the faint included
    cut_bounds: Sequence[float] = ()  # by degree: bound on a colour's change if all SH bands above it are cut
    seconds: float = 0.0  # that it took


def decisive_for_any(cameras: Sequence[Camera | MiniCam], gaussians: GaussianModel, pipe: argparse.Namespace) -> Tensor:
    """Mark the Gaussians that the image of any camera, at its size, depends on: (N,) bool."""
    found = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.get_xyz.device)
    for camera in Bar(cameras, desc="Looking for unseen Gaussians", unit="view", leave=False):
        found |= decisive_for(camera, gaussians, pipe)
    return found


def fewest_views(cameras: Sequence[Camera]) -> int:
    """Number of views of a walk along the minimum spanning tree of the cameras, with the cameras themselves."""
    return (1 + len(FRACTIONS)) * len(cameras) - len(FRACTIONS)


def walk_pairs(cameras: Sequence[Camera], most: float) -> tuple[list[tuple[int, int]], int]:
    """Choose pairs of cameras to walk between; return them and the number of views, with the cameras themselves.

    Each camera has up to NEAREST neighbours, as many as give at most `most` views; if none do, as few as possible.
    """
    pairs, views = [], fewest_views(cameras)
    for nearest in range(NEAREST, -1, -1) if views <= most else ():
        pairs = neighbours(cameras, nearest)
        views = len(cameras) + len(FRACTIONS) * len(pairs)
        if views <= most:
            break
    return pairs, views


def search_unseen(
    gaussians: GaussianModel, cameras: Sequence[Camera], pipe: argparse.Namespace, iterations: int
) -> Search:
    """Find the Gaussians that are invisible on a walk from camera to camera.

    Gaussians below FAINT are in no image at all. Others are unseen if neither a camera nor a view between neighbouring
    cameras depends on them (gaussian_renderer/free_view.py). They are kept if they are fewer than WORTH, or if the
    search takes more than one view for ITERATIONS_PER_VIEW of the `iterations` trained.
    """
    keep = gaussians.raw("opacity").detach()[:, 0] >= FAINT
    shards = gaussians.shards
    search = Search(keep, faint=shards.count_marked(~keep))
    most, search.views = iterations / ITERATIONS_PER_VIEW, fewest_views(cameras)
    if search.views > most:
        search.end = TOO_LONG
        return search
    seen, search.views = decisive_for_any(cameras, gaussians, pipe), len(cameras)
    # To find neighbours loads SciPy, which takes longer than the search of most models.
    enough = shards.count_marked(keep & ~seen) >= WORTH * gaussians.gaussian_count
    pairs = walk_pairs(cameras, most)[0] if enough else []
    walks = chain.from_iterable(views_between(cameras[i], cameras[j]) for i, j in pairs)
    total = len(FRACTIONS) * len(pairs)
    for camera in Bar(walks, desc="Looking between", total=total, unit="view", leave=False, disable=not total):
        if shards.count_marked(keep & ~seen) < WORTH * gaussians.gaussian_count:
            break
        seen |= decisive_for(camera, gaussians, pipe)
        search.views += 1
    few = shards.count_marked(keep & ~seen) < WORTH * gaussians.gaussian_count
    search.end = FEW if few else DONE
    search.keep = keep if few else keep & seen
    return search


def trim(
    gaussians: GaussianModel,
    cameras: Sequence[Camera],
    pipe: argparse.Namespace,
    keep_unseen: bool,
    prune_sh: float,
    iterations: int,
) -> tuple[GaussianModel, Search]:
    """Copy a model without Gaussians and SH bands that the training views and views between them do not need.

    Unless bands that are not zero are cut, the renders of `cameras` keep every bit, or on a GPU change by rounding (see
    `decisive`).

    cameras: the training views.
    keep_unseen: leave no Gaussian out.
    prune_sh: largest change of a colour (in [0, 1]) by cut SH bands; -1 cuts none, 0 those that are zero.
    iterations: length of the training.

    Returns the new model, and the result of the search.
    """
    start = time.perf_counter()
    every = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.get_xyz.device)
    search = Search(every) if keep_unseen else search_unseen(gaussians, cameras, pipe, iterations)
    shards = gaussians.shards
    if not shards.count_marked(search.keep):  # never an empty model
        search = Search(every, end=FEW)
    search.unseen = shards.count_marked(~search.keep)
    kept = search.keep if search.unseen else slice(None)
    search.cut_bounds = cut_bounds(gaussians.get_features_rest.detach(), shards, search.keep)
    degree = gaussians.max_sh_degree if prune_sh < 0 else needed_degree(search.cut_bounds, prune_sh)
    if search.unseen or degree < gaussians.max_sh_degree:
        gaussians = gaussians.part(kept, degree)
    search.seconds = time.perf_counter() - start
    return gaussians, search


@torch.no_grad()
def change_on_views(
    before: GaussianModel, after: GaussianModel, cameras: Sequence[Camera], views: ScoredViews, scored: bool
) -> dict[str, float]:
    """Compare the renders of two models: `largest` is the largest difference of a value in [0, 1].

    scored: add `psnr_before` and `psnr_after`, dB.
    """
    change = {"largest": max(float((views.image(c, before) - views.image(c, after)).abs().max()) for c in cameras)}
    if scored:
        for name, model in (("psnr_before", before), ("psnr_after", after)):
            scores = views.scores(cameras, model)
            change |= {name: scores["psnr"]} if scores else {}
    return change
