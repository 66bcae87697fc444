"""Relocation and noise (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians are taken for samples of a distribution, and training for a random walk among them. What departs from the
paper: opacities and scales are penalised by their means, as in the authors' release, where the paper writes sums;
Adam's averages restart for the moved Gaussians as well as for those that they come to.
"""

import argparse
from collections.abc import Collection

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.gaussians.adc import remove_useless
from scene.gaussians.morton import sort_rows
from scene.gaussians.penalty import NO_PENALTY, Penalty
from splatting.parts.mcmc.rules import add_noise, grow, is_alive, relocate, start_as
from splatting.training.density import DensityControl, refuse_empty
from splatting.training.iteration import Iteration

MOST_GAUSSIANS = 1_000_000  # where --max_num_splats is 0
INIT_SCALES = (0.1, 1.0)  # of the paper's long trainings, and of those by the clock, which are too short for it


class MarkovChain(DensityControl):
    """The strategy of the MCMC paper, with the rules beside it. It resets no opacities."""

    fusable = True
    clamps = False
    default_is_limit = True
    queues = True

    def __init__(
        self, gaussians: GaussianModel, opt: argparse.Namespace, most: int = MOST_GAUSSIANS, penalised: bool = True
    ) -> None:
        self._gaussians = gaussians
        self._opt = opt
        self.max_gaussians = opt.max_num_splats or most
        self._penalised = penalised
        self.ends = opt.mcmc_until_iter

    @property
    def penalty(self) -> Penalty:
        """Of scales as they are drawn, so that it does not depend on the unit."""
        if not self._penalised:
            return NO_PENALTY
        return Penalty(self._opt.mcmc_opacity_reg, self._opt.mcmc_scale_reg * self._gaussians.enlargement)

    def too_slow(self) -> str:
        return f"--mcmc_growth {self._opt.mcmc_growth:g} adds too few each time; raise it"

    def started(self) -> None:
        """Make Gaussians more opaque and smaller than those of adaptive density control (as the authors' release)."""
        scale = self._opt.mcmc_init_scale or INIT_SCALES[self.schedule.paced]
        start_as(self._gaussians, self._opt.mcmc_init_opacity, scale)

    def changes(self, iteration: int) -> bool:
        opt = self._opt
        within = opt.densify_from_iter < self.schedule.schedule_step(iteration) < opt.mcmc_until_iter
        stride = self.schedule.stride(iteration)
        return within and iteration % rules.interval(opt, opt.mcmc_until_iter, stride) == 0

    def projected_count(self, count: int, first: int, last: int) -> int:
        for iteration in filter(
            self.changes, range(first, min(last, self.ends))
        ):  # the last is saved before its change
            count = max(count, self._grown(count, iteration))
        return count

    def replaced(self, iteration: int) -> Collection[str]:
        """All, unless there is nothing to do: then the Gaussians take their step."""
        gaussians, least = self._gaussians, self._opt.mcmc_min_opacity
        if not self.changes(iteration):
            return ()
        count = gaussians.gaussian_count
        moves = 0 < self.count_limit(iteration, count, 0) < count or self._grown(count, iteration) > count
        moves = moves or gaussians.shards.ranks.anyone(not is_alive(gaussians, least).all())
        return gaussians._attributes if moves else ()

    def before_step(self, step: Iteration) -> None:
        if self.changes(step.iteration):
            self._relocate(step.iteration)
            self._grow(step.iteration)

    def after_step(self, step: Iteration) -> None:
        """Add the noise of the random walk (the paper's update by Langevin dynamics)."""
        if self.changes(step.iteration):
            sort_rows(self._gaussians)
        factor = self._gaussians.enlargement**2  # as covariances have the square of the unit
        rate = self._gaussians.position_learning_rate * self._opt.mcmc_noise * factor
        add_noise(self._gaussians, rate, seed=self._opt.seed, iteration=step.iteration)

    def _relocate(self, iteration: int) -> None:
        """Move what nobody sees (the paper's relocation of dead Gaussians), or remove random points (`count_limit`)."""
        least = self._opt.mcmc_min_opacity
        count = self._gaussians.gaussian_count
        if 0 < (most := self.count_limit(iteration, count, 0)) < count:
            remove_useless(self._gaussians, least, most)
        dead = relocate(self._gaussians, least, seed=self._opt.seed, iteration=iteration)
        empty = dead == self._gaussians.gaussian_count
        refuse_empty(iteration, empty, "lower --mcmc_opacity_reg", f"with an opacity above {least} in")

    def _grow(self, iteration: int) -> None:
        """Grow to `_grown`."""
        count = self._gaussians.gaussian_count
        new = self._grown(count, iteration) - count
        if new > 0:
            grow(self._gaussians, new, seed=self._opt.seed, iteration=iteration)

    def _grown(self, count: int, iteration: int) -> int:
        """The number after a growth: more by a part of it (the paper's rule of adding Gaussians), at least by one."""
        growth = self._opt.mcmc_growth
        most = self.count_limit(iteration, count, self.max_gaussians)
        return min(max(int((1 + growth) * count), count + (growth > 0)), most)
