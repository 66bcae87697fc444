"""Adaptive density control, the method's own (Kerbl et al. 2023, Section 5.2): clone, split, prune, reset.

A base for strategies that are like it. They may override `densify`.
"""

import argparse
import copy
import sys
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.gaussians.morton import sort_rows
from splatting.training.density import DensityControl, refuse_empty
from splatting.training.iteration import Iteration

if TYPE_CHECKING:
    from splatting.training.run import Run


class AdaptiveDensityControl(DensityControl):
    """Adaptive density control (Kerbl et al. 2023, Section 5.2), with the rules of scene/gaussians/density_rules.py.

    extent: of the scene, world units; sizes are judged by it. threshold: of a Gaussian's mean screen-space gradient,
    per NDC unit, from which on it is cloned or split; with absolute_threshold, of its pixels' absolute gradients (Ye et
    al. 2024, AbsGS).
    """

    fusable = True
    grows_to = False

    def __init__(
        self,
        gaussians: GaussianModel,
        opt: argparse.Namespace,
        white_background: bool,
        extent: float,
        absolute_threshold: float | None = None,
    ) -> None:
        self._gaussians = gaussians
        self._opt = opt
        self._white_background = white_background
        self._extent = extent
        self.absolute_gradients = absolute_threshold is not None
        self.threshold = absolute_threshold if self.absolute_gradients else opt.densify_grad_threshold
        self.ends = opt.densify_until_iter
        self.max_gaussians = opt.max_num_splats

    @classmethod
    def of_run(cls, run: "Run", *more: Any, **options: Any) -> "AdaptiveDensityControl":
        """For a run; more, options: as for the class.

        Where a part needs bright renders, opacities are reset at an interval that is given, or never.
        """
        opt, white = run.opt, run.dataset.white_background
        if any(part.needs.bright for part in run.parts) and opt.opacity_reset_interval == rules.USUAL_RESETS:
            opt, white = copy.copy(opt), False
            opt.opacity_reset_interval = sys.maxsize
        return cls(run.gaussians, opt, white, run.scene.cameras_extent, *more, **options)

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
            self.densify(step.iteration, todo.limit_size)
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

    def densify(self, iteration: int, limit_size: bool) -> None:
        """Clone, split and prune by the statistics, which start anew. limit_size: prune what is large on screen."""
        self._gaussians.densify_and_prune(
            self.threshold,
            rules.MIN_OPACITY,
            self._extent,
            rules.MAX_SCREEN_SIZE if limit_size else None,
            seed=self._opt.seed,
            iteration=iteration,
            max_splats=self.count_limit(iteration, self._gaussians.gaussian_count, self.max_gaussians),
        )
        refuse_empty(iteration, self._gaussians.gaussian_count == 0, "raise --opacity_reset_interval")
        sort_rows(self._gaussians)
