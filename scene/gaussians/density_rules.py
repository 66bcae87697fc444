"""Rules of adaptive density control (Kerbl et al. 2023, section 5.2) on raw parameters, without any state.

Sizes and opacities are compared as logarithms and logits: the last bits of an exp or sigmoid could change a decision.
"""

import argparse
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.density import split_positions
from torch import Tensor

from groundwork.deterministic.counter_rng import Stream
from groundwork.ranks.rows import WHOLE, Shards

SHRINK = 0.8  # N children of a split have 1 / (0.8 N) of the parent's scale: 1 / 1.6 for two (paper, section 5.2)
PRUNE_EXTENT = 0.1  # a Gaussian wider than this part of the scene's extent is removed, once sizes are limited
RESET_OPACITY = 0.01
RECOVERY = 1000  # iterations that a model needs to recover from a reset of its opacities
USUAL_RESETS = 3000  # iterations from one reset to the next, the default of --opacity_reset_interval
FEW_DENSIFICATIONS = 20  # a run that takes fewer steps than its schedule still has so many
MIN_OPACITY = 0.005  # a Gaussian below it is removed
MAX_SCREEN_SIZE = 20  # pixels
PIXELS = 64  # training pixels of all views for each Gaussian of the default budget
FEWEST, MOST = 100_000, 1_000_000  # Gaussians of the default budget
FEW_PHOTOS = 50  # to which trainings overfit
MOST_BAND_RATE = 2.0


def default_budget(cameras: Sequence[Any]) -> int:
    """The number of Gaussians to reach where --max_num_splats is 0: one for PIXELS pixels, from FEWEST to MOST."""
    pixels = sum(camera.image_width * camera.image_height for camera in cameras)
    return min(max(pixels // PIXELS, FEWEST), MOST)


def band_rate(cameras: Sequence[Any]) -> float:
    """Compute the factor of the learning rate of SH bands above degree 0: photos / FEW_PHOTOS, at most MOST_BAND_RATE.

    Few photos see a Gaussian from few sides, and bands soon fit what is only in them.
    """
    return min(len(cameras) / FEW_PHOTOS, MOST_BAND_RATE)


class Actions(NamedTuple):
    """Answers of density control for one iteration. What is due happens in this order."""

    changes: bool = False  # rows or opacities may change
    observe: bool = False  # the view is added to the statistics
    densify: bool = False
    limit_size: bool = False  # densification also removes Gaussians that are too wide
    reset_opacity: bool = False
    recovers: bool = False  # opacities were reset so recently that renders do not resemble photos yet


class Window(NamedTuple):
    """The densifications of a training: after step `start` of the schedule, before `end`, every `stride` iterations.

    The stride is of iterations, as statistics need views.
    """

    start: int
    end: int
    stride: int

    def interval(self, pace: float) -> int:
        """Return the iterations from one densification to the next.

        pace: steps of the schedule for each iteration. Where they are several, there would be too few densifications.
        """
        if pace <= 1:
            return self.stride
        return min(self.stride, max(1, int((self.end - self.start) / pace / FEW_DENSIFICATIONS)))

    def is_due(self, iteration: int, step: int, pace: float) -> bool:
        """Tell whether an iteration densifies by the window's end and stride.

        step: the iteration's step of the schedule.
        """
        return step < self.end and iteration % self.interval(pace) == 0


def actions(
    iteration: int,
    opt: argparse.Namespace,
    white_background: bool,
    span: range | None = None,
    stride: float = 1.0,
) -> Actions:
    """Actions due in an iteration (paper, section 5.2, in the reference's windows): none from densify_until_iter on.

    span, stride: the iterations of the schedule that it stands for, and their mean number there; by default itself.
    The options' windows and resets are of the schedule. Resets that do not pay are left out.
    """
    before, now = (iteration - 1, iteration) if span is None else (span.start - 1, span.stop - 1)
    start, end, resets = opt.densify_from_iter, opt.densify_until_iter, opt.opacity_reset_interval
    if now >= end:
        return Actions(limit_size=now > resets)
    window = Window(start, end, opt.densification_interval)
    of_white = white_background and before < start <= now
    reset = (now // resets > before // resets and reset_pays(now, opt, stride)) or (
        of_white and reset_pays(now, opt, stride, of_white)
    )
    densify = now > start and window.is_due(iteration, now, stride)
    return Actions(densify or reset, True, densify, now > resets, reset)


def reset_pays(step: int, opt: argparse.Namespace, stride: float = 1.0, of_white: bool = False) -> bool:
    """Tell whether a model recovers from a reset at an iteration of the schedule before the next reset and the end.

    With less than half an interval to go, haze remains. of_white: the reset at densify_from_iter; its interval is at
    most the usual one, as a longer option only means that there are no other resets.
    """
    resets = opt.opacity_reset_interval
    half = (min(resets, USUAL_RESETS) if of_white else resets) / 2
    return opt.iterations - step >= half and (stride <= 1 or resets >= RECOVERY * stride)


def logit(p: float) -> float:
    """Inverse of the sigmoid, for 0 < p < 1."""
    return math.log(p / (1.0 - p))


def _log(x: float) -> float:
    return math.log(x) if x > 0 else -math.inf


def _logit(p: float) -> float:
    """`logit` for any number: below 0 and above 1 the limits."""
    return logit(p) if 0 < p < 1 else math.copysign(math.inf, p - 0.5)


def mean_gradient(accumulated: Tensor, count: Tensor) -> Tensor:
    """Average length of the screen-space gradient over the views that saw each Gaussian, 0 if none did: (N,)."""
    mean = (accumulated / count).reshape(-1)
    return torch.where(mean.isnan(), 0.0, mean)


def limit_growth(gradient: Tensor, threshold: float, most: int, shards: Shards = WHOLE) -> Tensor:
    """Zero the gradients of all candidates (>= threshold) except the `most` largest, ties by index: (N,)."""
    candidates = (gradient >= threshold).nonzero().reshape(-1)
    if shards.ranks.offset_and_total(len(candidates))[1] <= most:
        return gradient
    grow = candidates[shards.lowest(gradient[candidates], most, highest=True)]
    return gradient.index_fill(0, candidates, 0.0).index_copy_(0, grow, gradient[grow])


def is_small(scaling: Tensor, limit: float) -> Tensor:
    """Tell whether the largest scale is <= limit (world units), from log scales (N, 3): (N,) bool."""
    return scaling.amax(dim=1) <= _log(limit)


def is_useless(opacity: Tensor, min_opacity: float) -> Tensor:
    """Tell whether the opacity is below `min_opacity`, from logits (N, 1): (N,) bool."""
    return opacity.reshape(-1) < _logit(min_opacity)


def split_children(
    xyz: Tensor,
    scaling: Tensor,
    rotation: Tensor,
    items: Tensor,
    child: int,
    *,
    count: int = 2,
    seed: int,
    iteration: int,
) -> tuple[Tensor, Tensor]:
    """Positions (n, 3) and log scales (n, 3) of one of `count` children per parent.

    A position is mu + R(q) e, where e is normal with the parent's scales. Parents are given raw: xyz (n, 3), log
    scales (n, 3), quaternions (n, 4) wxyz. Their indices `items` (n,), seed, iteration and child decide the random
    numbers.
    """
    shapes = xyz.float(), scaling.float(), rotation.float()
    draw = {"seed": seed, "stream": Stream.SPLIT, "iteration": iteration, "draw": child}
    return split_positions(*shapes, items, **draw), scaling - math.log(SHRINK * count)
