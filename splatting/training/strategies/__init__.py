"""Strategies: how many Gaussians there are, and where. Each is a file, whose name is that of --strategy."""

from importlib import import_module
from typing import TYPE_CHECKING

from splatting.training.density import DensityControl

if TYPE_CHECKING:
    from splatting.training.run import Run


def density_control(run: "Run") -> DensityControl:
    """The strategy that --strategy names, for the model and the scene of a run: `of_run` of the file of that name."""
    return import_module(f"{__name__}.{run.opt.strategy}").of_run(run)
