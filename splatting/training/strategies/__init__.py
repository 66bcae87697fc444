"""Strategies: how many Gaussians there are, and where. Each is a file, chosen by --strategy."""

from typing import TYPE_CHECKING

from splatting.training.density import DensityControl
from splatting.training.strategies.adc import AdaptiveDensityControl
from splatting.training.strategies.budget import BudgetControl
from splatting.training.strategies.mcmc import MarkovChain

if TYPE_CHECKING:
    from splatting.training.run import Run


def density_control(run: "Run") -> DensityControl:
    """The strategy that --strategy names, for the model and the scene of a run."""
    if run.opt.strategy == "budget":
        return BudgetControl(run)
    if run.opt.strategy == "mcmc":
        return MarkovChain(run.gaussians, run.opt)
    parts = run.gaussians, run.opt, run.dataset.white_background, run.scene.cameras_extent
    return AdaptiveDensityControl(*parts)
