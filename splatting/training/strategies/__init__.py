"""Strategies: how many Gaussians there are, and where. Each is a file, whose name is that of --strategy."""

import argparse
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

import torch

from scene.cameras import Camera
from splatting.training.density import DensityControl

if TYPE_CHECKING:
    from splatting.training.run import Run

AUTO, USUAL = "auto", "adc"
# By the clock `budget` is best, but mcmc with few photos and the time for 250 iterations of each on a GPU. See
# docs/guide/strategies.md.
FEW, SECONDS = 50, 0.25  # training photos; seconds for each


def of_clock(seconds: float, cameras: Sequence[Camera], device: torch.device) -> str:
    """The strategy that is best in so many seconds, which --strategy auto takes for a new run with --time_budget."""
    few = len(cameras) <= FEW and seconds >= SECONDS * len(cameras)
    return "mcmc" if few and device.type == "cuda" else "budget"


def end_in_time(opt: argparse.Namespace) -> None:
    """Let rows change no longer than by default, 1/2 or 5/6 of the schedule, where that is to go on to its end.

    A run by the clock has few iterations, and needs the last ones for what it has.
    """
    for name, part in (("densify_until_iter", 1 / 2), ("mcmc_until_iter", 5 / 6)):
        if getattr(opt, name) >= opt.iterations:
            setattr(opt, name, int(part * opt.iterations))


def density_control(run: "Run") -> DensityControl:
    """The strategy that --strategy names, for the model and the scene of a run: `of_run` of the file of that name."""
    return import_module(f"{__name__}.{run.opt.strategy}").of_run(run)
