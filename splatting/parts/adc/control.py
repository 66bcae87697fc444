"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2): clone, split, prune, reset.

--absgrad judges a Gaussian by its pixels' absolute gradients (Ye et al. 2024, AbsGS) with a threshold of its own, for
splits and for clones. --split long_axis splits along the longest axis (scene/gaussians/long_axis.py).
"""

import argparse
from collections.abc import Collection

from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.gaussians.morton import sort_rows
from splatting.training.density import DensityControl, refuse_empty
from splatting.training.iteration import Iteration


class AdaptiveDensityControl(DensityControl):
    """Adaptive density control (Kerbl et al. 2023, Section 5.2), with the rules of scene/gaussians/density_rules.py.

    extent: of the scene, world units; sizes are judged by it.
    """

    fusable = True
    grows_to = False

    def __init__(
        self, gaussians: GaussianModel, opt: argparse.Namespace, white_background: bool, extent: float
    ) -> None:
        self._gaussians = gaussians
        self._opt = opt
        self._white_background = white_background
        self._extent = extent
        self.absolute_gradients = opt.absgrad
        self.ends = opt.densify_until_iter
        self.max_gaussians = opt.max_num_splats

    def changes(self, iteration: int) -> bool:
        todo = self._actions(iteration)
        return todo.densify or todo.reset_opacity

    def observes(self, iteration: int) -> bool:
        """Whether the view of this iteration counts in the statistics."""
        return self._actions(iteration).observe

    def recovers(self, iteration: int) -> bool:
        now, resets = self.schedule.schedule_step(iteration), self._opt.opacity_reset_interval
        last = now - now % resets
        recovers = resets <= last < self.ends and now % resets < rules.RECOVERY
        pays = rules.reset_pays(last, self._opt, self.schedule.stride(iteration))
        return recovers and pays and not self._ends_too_soon(last, iteration)

    def replaced(self, iteration: int) -> Collection[str]:
        if self._actions(iteration).densify:
            return self._gaussians._attributes
        return ["opacity"] if self.resets(iteration) else ()

    def after_backward(self, step: Iteration, package: dict[str, Tensor]) -> None:
        if self.observes(step.iteration):
            observe = self._gaussians.observe_absolute if self.absolute_gradients else self._gaussians.observe
            observe(package["viewspace_points"], package["radii"])
        self.before_step(step)

    def before_step(self, step: Iteration) -> None:
        todo = self._actions(step.iteration)
        if todo.densify:
            self._densify(step.iteration, todo.limit_size)
        if self.resets(step.iteration):
            self._gaussians.reset_opacity()

    def resets(self, iteration: int) -> bool:
        step = self.schedule.schedule_step(iteration)
        return self._actions(iteration).reset_opacity and not self._ends_too_soon(step, iteration)

    def _ends_too_soon(self, step: int, iteration: int) -> bool:
        """Whether a run by the clock, at the pace of an iteration, could not recover from a reset at a step."""
        schedule = self.schedule
        left = (schedule.length - step) / schedule.stride(iteration)
        return schedule.paced and left < rules.RECOVERY

    def _actions(self, iteration: int) -> rules.Actions:
        schedule = self.schedule
        place = schedule.span(iteration), schedule.stride(iteration)
        return rules.actions(iteration, self._opt, self._white_background, *place)

    def _densify(self, iteration: int, limit_size: bool) -> None:
        self._gaussians.densify_and_prune(
            self._opt.absgrad_threshold if self.absolute_gradients else self._opt.densify_grad_threshold,
            rules.MIN_OPACITY,
            self._extent,
            rules.MAX_SCREEN_SIZE if limit_size else None,
            seed=self._opt.seed,
            iteration=iteration,
            max_splats=self.count_limit(iteration, self._gaussians.gaussian_count, self.max_gaussians),
            long_axis=self._opt.split == "long_axis",
        )
        refuse_empty(iteration, self._gaussians.gaussian_count == 0, "raise --opacity_reset_interval")
        sort_rows(self._gaussians)
