"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2): clone, split, prune, reset."""

import argparse
import copy
import sys
from collections.abc import Collection
from typing import Any

from scene.gaussians import density_rules
from scene.gaussians.adc import refuse_empty
from scene.gaussians.density_rules import Actions
from scene.gaussians.morton import sort_rows
from splatting.iteration import Iteration
from splatting.part import Strategy


class Adc(Strategy):
    """Adaptive density control, by the rules of scene/gaussians/density_rules.py. Similar ones override `densify`.

    threshold: mean screen-space gradient of a Gaussian, per NDC unit, from which on the Gaussian is cloned or split.
        With absolute_gradients, the gradient is made of its pixels' absolute gradients (Ye et al. 2024, AbsGS).
    """

    name = "adc"
    fusable = True
    grows_to = False

    @classmethod
    def takes_absolute(cls, opt: argparse.Namespace) -> bool:
        return opt.absgrad

    def begin(self, run: Any, state: Any) -> None:
        """Take the rules and their numbers from the options.

        Where a part allows no resets, opacities are reset only at an interval that a user gives.
        """
        super().begin(run, state)
        opt, self._white_background = run.opt, run.dataset.white_background
        usual = opt.opacity_reset_interval == density_rules.USUAL_RESETS
        if usual and not all(part.needs.resets for part in run.parts):
            opt, self._white_background = copy.copy(opt), False
            opt.opacity_reset_interval = sys.maxsize
        self._gaussians, self._opt, self._rules = run.gaussians, opt, density_rules
        self._extent = run.scene.cameras_extent  # by which sizes are judged
        self.absolute_gradients = self.takes_absolute(opt)
        self.threshold = opt.absgrad_threshold if self.absolute_gradients else opt.densify_grad_threshold
        self.ends, self.max_gaussians = opt.densify_until_iter, opt.max_num_splats

    def changes(self, iteration: int) -> bool:
        todo = self._actions(iteration)
        return todo.densify or todo.reset_opacity

    def observes(self, iteration: int) -> bool:
        return self._actions(iteration).observe

    def recovers(self, iteration: int) -> bool:
        now, resets = self.schedule.schedule_step(iteration), self._opt.opacity_reset_interval
        last = now - now % resets
        recovers = resets <= last < self.ends and now % resets < self._rules.RECOVERY
        pays = self._rules.reset_pays(last, self._opt, self.schedule.stride(iteration))
        return recovers and pays and not self._ends_too_soon(last, iteration)

    def resets(self, iteration: int) -> bool:
        step = self.schedule.schedule_step(iteration)
        return self._actions(iteration).reset_opacity and not self._ends_too_soon(step, iteration)

    def skips_step(self, iteration: int) -> Collection[str]:
        if self._actions(iteration).densify:
            return self._gaussians._attributes
        return ["opacity"] if self.resets(iteration) else ()

    def after_backward(self, at: Iteration, package: dict[str, Any]) -> None:
        if self.observes(at.iteration):
            observe = self._gaussians.observe_absolute if self.absolute_gradients else self._gaussians.observe
            observe(package["viewspace_points"], package["radii"])
        self.change_rows(at)

    def change_rows(self, at: Iteration) -> None:
        todo = self._actions(at.iteration)
        if todo.densify:
            self.densify(at.iteration, todo.limit_size)
        if self.resets(at.iteration):
            self._gaussians.reset_opacity()

    def _ends_too_soon(self, step: int, iteration: int) -> bool:
        """Tell whether a run by the clock is too short to recover from a reset at a step.

        The pace is that of an iteration.
        """
        schedule = self.schedule
        left = (schedule.length - step) / schedule.stride(iteration)
        return schedule.paced and left < self._rules.RECOVERY

    def _actions(self, iteration: int) -> Actions:
        place = self.schedule.span(iteration), self.schedule.stride(iteration)
        return self._rules.actions(iteration, self._opt, self._white_background, *place)

    def densify(self, iteration: int, limit_size: bool) -> None:
        """Clone, split and prune by the statistics, which then start anew.

        limit_size: true to prune what is large on screen.
        """
        gaussians, most = self._gaussians, self.max_gaussians
        gaussians.densify_and_prune(
            self.threshold,
            self._rules.MIN_OPACITY,
            self._extent,
            self._rules.MAX_SCREEN_SIZE if limit_size else None,
            seed=self._opt.seed,
            iteration=iteration,
            max_splats=self.schedule.count_limit(iteration, gaussians.gaussian_count, most, most),
        )
        refuse_empty(iteration, gaussians.gaussian_count == 0, "raise --opacity_reset_interval")
        sort_rows(gaussians)
