"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2): clone, split, prune, reset."""

import argparse
import copy
import sys
from collections.abc import Collection
from typing import Any

from scene.gaussians import density_rules as rules
from scene.gaussians.adc import refuse_empty
from scene.gaussians.density_rules import Actions
from scene.gaussians.morton import sort_rows
from splatting.iteration import Iteration
from splatting.part import Strategy


class Adc(Strategy):
    """Adaptive density control, by the rules of scene/gaussians/density_rules.py. Similar ones override `densify`.

    threshold: mean screen-space gradient of a Gaussian, per NDC unit, from which on the Gaussian is cloned or split.
        With absolute gradients, the gradient is made of its pixels' absolute gradients (Ye et al. 2024, AbsGS).
    """

    name = "adc"
    fusable = True

    @classmethod
    def takes_absolute(cls, opt: argparse.Namespace) -> bool:
        return opt.absgrad

    def begin(self, run: Any, state: Any) -> None:
        """Take the numbers of the rules from the options.

        Where a part allows no resets, opacities are reset only at an interval that a user gives.
        """
        super().begin(run, state)
        opt, self._white_background = run.opt, run.dataset.white_background
        usual = opt.opacity_reset_interval == rules.USUAL_RESETS
        if usual and not all(part.needs.resets for part in run.parts):
            self._opt, self._white_background = copy.copy(opt), False
            self._opt.opacity_reset_interval = sys.maxsize
        self._extent = run.scene.cameras_extent  # by which sizes are judged
        self.threshold = opt.absgrad_threshold if self.takes_absolute(opt) else opt.densify_grad_threshold
        self.max_gaussians = opt.max_num_splats

    def actions(self, iteration: int) -> Actions:
        """Return what density control does in an iteration.

        A run by the clock leaves out resets of opacities from which it is too short to recover.
        """
        opt, schedule = self._opt, self.schedule
        span, stride, resets = schedule.span(iteration), schedule.stride(iteration), opt.opacity_reset_interval
        todo, now = rules.actions(iteration, opt, self._white_background, span, stride), span.stop - 1
        last = now - now % resets
        recovers = resets <= last < self.window.end and now - last < rules.RECOVERY
        return todo._replace(
            reset_opacity=todo.reset_opacity and self._has_time(now, stride),
            recovers=recovers and rules.reset_pays(last, opt, stride) and self._has_time(last, stride),
        )

    def _has_time(self, step: int, stride: float) -> bool:
        """Tell whether a run is long enough to recover from a reset at a step, which only a clock may shorten.

        stride: steps of an iteration, by the present pace.
        """
        return not self.schedule.paced or (self.schedule.length - step) / stride >= rules.RECOVERY

    def skips_step(self, at: Iteration) -> Collection[str]:
        if at.density.densify:
            return self._gaussians._attributes
        return ["opacity"] if at.density.reset_opacity else ()

    def change_rows(self, at: Iteration) -> None:
        if at.density.densify:
            self.densify(at.iteration, at.density.limit_size)
        if at.density.reset_opacity:
            self._gaussians.reset_opacity()

    def densify(self, iteration: int, limit_size: bool) -> None:
        """Clone, split and prune by the statistics, which then start anew.

        limit_size: true to prune what is large in the scene, as the reference does from its first reset on.
        """
        gaussians, most = self._gaussians, self.max_gaussians
        gaussians.densify_and_prune(
            self.threshold,
            rules.MIN_OPACITY,
            self._extent,
            rules.MAX_SCREEN_SIZE if limit_size else None,
            seed=self._opt.seed,
            iteration=iteration,
            max_splats=self.schedule.count_limit(iteration, gaussians.gaussian_count, most, most),
        )
        refuse_empty(iteration, gaussians.gaussian_count == 0, "raise --opacity_reset_interval")
        sort_rows(gaussians)
