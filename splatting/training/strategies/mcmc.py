"""Relocation and noise (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians are taken for samples of a distribution, and training for a random walk among them. What departs from the
paper: opacities and scales are penalised by their means, as in the authors' release, where the paper writes sums;
Adam's averages restart for the moved Gaussians as well as for those that they come to; a Gaussian that would be divided
into more than `--mcmc_parts` is corrected for so many.
"""

import argparse

from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.gaussians.mcmc import Penalty
from splatting.training.density import DensityControl
from splatting.training.step import Step
from utils.system_utils import UserError

MOST_GAUSSIANS = 1_000_000  # where --max_num_splats is 0


class MarkovChain(DensityControl):
    """The strategy of the MCMC paper, with the rules of scene/gaussians/mcmc.py. It resets no opacities."""

    fusable = True
    clamps = False
    queues = True

    def __init__(self, gaussians: GaussianModel, opt: argparse.Namespace) -> None:
        self._gaussians = gaussians
        self._opt = opt
        self.most_gaussians = opt.max_num_splats or MOST_GAUSSIANS
        self.penalty = Penalty(opt.mcmc_opacity_reg, opt.mcmc_scale_reg)
        self.ends = opt.mcmc_until_iter

    def started(self) -> None:
        """Make Gaussians more opaque and smaller than adaptive density control wants them (as the authors' release)."""
        self._gaussians.start_as(self._opt.mcmc_init_opacity, self._opt.mcmc_init_scale)

    def changes(self, iteration: int) -> bool:
        opt = self._opt
        within = opt.densify_from_iter < self.pace.nominal(iteration) < opt.mcmc_until_iter
        stride = self.pace.stride(iteration)
        return within and iteration % rules.interval(opt, opt.mcmc_until_iter, stride, self.pace.views) == 0

    def most_after(self, count: int, first: int, last: int) -> int:
        for _ in filter(self.changes, range(first, last + 1)):
            count = max(count, self._grown(count))
        return count

    def after_backward(self, step: Step, package: dict[str, Tensor]) -> None:
        if self.changes(step.iteration):
            self._relocate(step.iteration)
            self._grow(step.iteration)

    def after_step(self, step: Step) -> None:
        """Add the noise of the random walk (the paper's update by Langevin dynamics)."""
        opt = self._opt
        rate = self._gaussians.position_rate * opt.mcmc_noise
        gate = opt.mcmc_gate_steepness, opt.mcmc_gate_opacity
        self._gaussians.add_noise(rate, *gate, seed=opt.seed, iteration=step.iteration)

    def _relocate(self, iteration: int) -> None:
        """Move what nobody sees (the paper's relocation of dead Gaussians)."""
        least, parts, seed = self._opt.mcmc_min_opacity, self._opt.mcmc_parts, self._opt.seed
        dead = self._gaussians.relocate(least, parts, seed=seed, iteration=iteration)
        if dead == self._gaussians.total:
            raise UserError(
                f"no Gaussian was left with an opacity above {least} in iteration {iteration}: the views do not agree "
                "with the points, or show nothing but the background; check the scene, or lower --mcmc_opacity_reg"
            )

    def _grow(self, iteration: int) -> None:
        """Grow to `_grown`."""
        count, opt = self._gaussians.total, self._opt
        new = self._grown(count) - count
        if new > 0:
            self._gaussians.grow(new, opt.mcmc_parts, seed=opt.seed, iteration=iteration)

    def _grown(self, count: int) -> int:
        """The number after a growth: more by a part of it (the paper's rule of adding Gaussians), at least by one."""
        growth = self._opt.mcmc_growth
        return min(max(int((1 + growth) * count), count + (growth > 0)), self.most_gaussians)
