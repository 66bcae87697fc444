"""Strategy mcmc: relocation and noise (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians are taken for samples of a distribution, and training for a random walk among them. Differences from the
paper:

- Opacities and scales are penalised by their means, as in the authors' release; the paper writes sums.
- Adam's averages restart for the moved Gaussians, and also for those that they come to.
- A step and its penalties concern what the view sees.
- SH bands learn faster from many photos.
"""

from collections.abc import Collection
from typing import Any

from scene.gaussians.adc import refuse_empty, remove_useless
from scene.gaussians.density_rules import FEW_PHOTOS, band_rate, default_budget
from scene.gaussians.morton import sort_rows
from scene.gaussians.penalty import Penalty
from splatting.features.mcmc_rules import add_noise, grow, is_alive, relocate, start_as
from splatting.iteration import Iteration
from splatting.part import Rates, Strategy

MOST_GAUSSIANS = 1_000_000  # where --max_num_splats is 0
INIT_SCALES = (0.1, 1.0)  # of the paper's long trainings, and of those by the clock, which are too short for it
SECONDS = 0.25  # for each training photo, at least: 250 iterations on a GPU (docs/guide/strategies.md)


class Mcmc(Strategy):
    """Moves Gaussians that nobody sees to others (splatting/features/mcmc_rules.py), and resets no opacities.

    In a given time, this strategy is best for few photos, on a GPU.
    """

    name = "mcmc"
    until = "mcmc_until_iter", 5 / 6
    fusable = True
    clamps = False
    queues = True

    @classmethod
    def best_in(cls, seconds: float, run: Any) -> bool:
        views = run.scene.getTrainCameras()
        few = len(views) <= FEW_PHOTOS and seconds >= SECONDS * len(views)
        return few and run.device.type == "cuda"

    def begin(self, run: Any, state: Any) -> None:
        """Choose rates, the largest number of Gaussians and penalties; new Gaussians become opaque and small."""
        super().begin(run, state)
        opt, paced, cameras = run.opt, run.schedule.paced, run.scene.getTrainCameras()
        self._rates = Rates(bands=band_rate(cameras))
        self.max_gaussians = opt.max_num_splats or (default_budget(cameras) if paced else MOST_GAUSSIANS)
        run.gaussians.step_sparsely()
        if run.starts_from_points:  # then more opaque and smaller than of adaptive density control, as released
            scale = opt.mcmc_init_scale or INIT_SCALES[paced]
            start_as(run.gaussians, opt.mcmc_init_opacity, scale)
        # Penalties need time; with little of it they only darken (fox_tiny, 1,243 iterations: -1.7 dB), except where
        # they clear away random points (nerf_lego200_tiny, 346 iterations: +17 dB).
        if not paced or self.best_in(run.schedule.seconds, run) or run.scene.info.ply_path is None:
            # Of scales as they are drawn, so that it does not depend on the unit.
            self.penalty = Penalty(opt.mcmc_opacity_reg, opt.mcmc_scale_reg * run.gaussians.enlargement)

    def rates(self, iteration: int) -> Rates:
        return self._rates

    def skips_step(self, at: Iteration) -> Collection[str]:
        """Return all attributes, unless there is nothing to change; then the Gaussians take their step."""
        gaussians, least, iteration = self._gaussians, self._opt.mcmc_min_opacity, at.iteration
        if not at.density.densify:
            return ()
        count = gaussians.gaussian_count
        moves = 0 < self._limit_count(iteration, count, 0) < count or self._next_count(count, iteration) > count
        moves = moves or gaussians.shards.ranks.any_rank(not is_alive(gaussians, least).all())
        return gaussians._attributes if moves else ()

    def change_rows(self, at: Iteration) -> None:
        if at.density.densify:
            self._relocate(at.iteration)
            self._grow(at.iteration)

    def after_step(self, at: Iteration) -> None:
        """Add the noise of the random walk (the paper's update by Langevin dynamics)."""
        if at.density.densify:
            sort_rows(self._gaussians)
        factor = self._gaussians.enlargement**2  # as covariances have the square of the unit
        rate = self._gaussians.position_learning_rate * self._opt.mcmc_noise * factor
        add_noise(self._gaussians, rate, seed=self._opt.seed, iteration=at.iteration)

    def _relocate(self, iteration: int) -> None:
        """Move what nobody sees (the paper's relocation of dead Gaussians), or remove random points (`count_limit`)."""
        least = self._opt.mcmc_min_opacity
        count = self._gaussians.gaussian_count
        if 0 < (most := self._limit_count(iteration, count, 0)) < count:
            remove_useless(self._gaussians, least, most)
        dead = relocate(self._gaussians, least, seed=self._opt.seed, iteration=iteration)
        empty = dead == self._gaussians.gaussian_count
        refuse_empty(iteration, empty, "lower --mcmc_opacity_reg", f"with an opacity above {least} in")

    def _grow(self, iteration: int) -> None:
        """Add Gaussians until there are as many as `_next_count` says."""
        count = self._gaussians.gaussian_count
        new = self._next_count(count, iteration) - count
        if new > 0:
            grow(self._gaussians, new, seed=self._opt.seed, iteration=iteration)

    def _next_count(self, count: int, iteration: int) -> int:
        """Return the number after a growth: more by a share (the paper's rule of adding Gaussians), at least by one."""
        growth = self._opt.mcmc_growth
        most = self._limit_count(iteration, count, self.max_gaussians)
        return min(max(int((1 + growth) * count), count + (growth > 0)), most)

    def _limit_count(self, iteration: int, count: int, limit: int) -> int:
        return self.schedule.count_limit(iteration, count, limit, self.max_gaussians)
