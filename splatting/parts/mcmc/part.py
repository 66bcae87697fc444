"""Relocation and noise (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo")."""

from typing import Any

from splatting.option import Option, at_least, within
from splatting.part import Options, Strategy

_PAPER = "ours, from the MCMC paper"
_RELEASED = "ours, from the release of the MCMC paper"
FEW, SECONDS = 50, 0.25  # training photos; seconds for each: 250 iterations on a GPU (docs/guide/strategies.md)


def _between(value: float) -> str | None:
    return None if 0 < value < 1 else "between 0 and 1, and neither of them"


class Mcmc(Strategy):
    """Moves Gaussians that nobody sees to others. In a given time it is best for few photos, on a GPU."""

    name = "mcmc"
    summary = "moves transparent Gaussians to opaque ones and adds noise to positions"
    until = "mcmc_until_iter", 5 / 6
    # fmt: off
    options = Options(optimisation=(
        Option("mcmc_until_iter", 25_000, origin=_RELEASED, check=at_least(0),
            help="mcmc: relocation and growth end before this step; --densify_until_iter has no effect then"),
        Option("mcmc_growth", 0.05, origin=_PAPER, check=within(0, 1),
            help="mcmc: growth in every densification, as a part of the number of Gaussians"),
        Option("mcmc_min_opacity", 0.005, origin=_PAPER, check=_between,
            help="mcmc: a Gaussian of this opacity or less is moved to another one"),
        Option("mcmc_noise", 500_000.0, origin=_PAPER, check=within(0, 1e9),
            help="mcmc: factor of the noise that moves Gaussians in every step, times the learning rate of positions"),
        Option("mcmc_opacity_reg", 0.01, origin=_PAPER, check=at_least(0),
            help="mcmc: weight of the mean opacity in the loss; higher: more Gaussians fade and are moved"),
        Option("mcmc_scale_reg", 0.01, origin=_PAPER, check=at_least(0),
            help="mcmc: weight of the mean scale (world units) in the loss; higher: smaller Gaussians"),
        Option("mcmc_init_opacity", 0.5, origin=_RELEASED, check=_between,
            help="mcmc: opacity of the Gaussians that are made from points"),
        Option("mcmc_init_scale", 0.0, origin=_RELEASED, check=at_least(0),
            help="mcmc: scale of the Gaussians that are made from points, as a part of the distance to their "
                 "neighbours; 0: 0.1, or 1 in a given time"),
    ))
    # fmt: on

    @classmethod
    def best_in(cls, seconds: float, run: Any) -> bool:
        views = run.scene.getTrainCameras()
        few = len(views) <= FEW and seconds >= SECONDS * len(views)
        return few and run.device.type == "cuda"

    def control(self, run: Any) -> Any:
        from splatting.parts.mcmc.control import MarkovChain
        from splatting.training.density import default_budget

        if not run.schedule.paced:
            return MarkovChain(run.gaussians, run.opt)
        # Penalties need time; with little of it they only darken (fox_tiny, 1,243 iterations: -1.7 dB), except where
        # they clear away random points (nerf_lego200_tiny, 346 iterations: +17 dB).
        useful = self.best_in(run.schedule.seconds, run) or run.scene.info.ply_path is None
        return MarkovChain(run.gaussians, run.opt, default_budget(run.scene.getTrainCameras()), penalised=useful)
