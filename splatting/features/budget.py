"""The strategy budget: growth to a given number of Gaussians, where the training views have errors.

Based on the growth curve of Mallick et al. 2024 (Taming 3DGS), the error-driven scores of Rota Bulo et al. 2024, and
the long-axis split of Deng et al. 2025 (Improved-GS). Differences from these papers:

- The growth curve is even, which was no worse on small scenes and trains fewer Gaussians.
- Scores are sums of a pixel error times blending weight over several views, and nothing else counts.
- Gaussians are drawn by their scores without replacement; the highest scores are not simply taken.
- Children keep their parent's mean and covariance.
- Opacities are multiplied by a factor, where Rota Bulo et al. subtract a constant.
- Adam averages squared gradients over fewer iterations, and SH bands learn faster from many photos.
"""

import math
from functools import partial
from typing import Any

from torch import Tensor

from groundwork.deterministic.counter_rng import Stream, permutation
from scene.cameras import Camera
from scene.gaussians.adc import refuse_empty, remove_useless
from scene.gaussians.density_rules import Actions, band_rate, default_budget
from scene.gaussians.morton import sort_rows
from splatting.features.budget_rules import error_scores, fade, split_in_two
from splatting.iteration import Iteration
from splatting.part import Rates, Strategy
from splatting.schedule import stride_rate_factor

SQUARES = 0.005  # 1 - beta2 of Adam in USUAL iterations; the paper has 0.001
LEAST_AVERAGED = 16  # iterations, over which squared gradients are averaged in any case
SCORED_VIEWS = 10  # at most, drawn anew in each densification
ITERATIONS_A_SCORE = 5  # at least, of a scored view


class Budget(Strategy):
    """Removes useless Gaussians and adds others, every densification_interval steps before densify_until_iter.

    The number of Gaussians at the end of that is max_gaussians. In a given time, this strategy is best in most cases.
    """

    name = "budget"
    fusable = True
    clamps = False

    @classmethod
    def best_in(cls, seconds: float, run: Any) -> bool:
        return True

    def begin(self, run: Any, state: Any) -> None:
        super().begin(run, state)
        self._cameras = run.scene.getTrainCameras()
        self._scores = partial(error_scores, run.gaussians, run.pipe, run.gaussians.exposures.applied)
        self.max_gaussians = run.opt.max_num_splats or default_budget(self._cameras)

    def rates(self, iteration: int) -> Rates:
        """Return learning rates and beta2 of Adam for runs with fewer iterations than USUAL, and thus longer steps.

        factor: grows with the root of the stride, the number of USUAL iterations that one iteration stands for, and
            falls at the end of the schedule (`stride_rate_factor`).
        bands: further factor of SH bands above degree 0, which is larger for more photos (`band_rate`).
        beta2: falls as the stride grows, so that Adam averages squared gradients over fewer iterations, LEAST_AVERAGED
            at least.
        """
        stride = self.schedule.usual_stride(iteration)
        factor = stride_rate_factor(stride, iteration / self.schedule.length)
        return Rates(factor, band_rate(self._cameras), 1.0 - min(SQUARES * math.sqrt(stride), 1 / LEAST_AVERAGED))

    def actions(self, iteration: int) -> Actions:
        """Return what density control does in an iteration: useless Gaussians are removed before the window, too."""
        due = self.window.is_due(iteration, self.schedule.schedule_step(iteration), self.schedule.stride(iteration))
        return Actions(changes=due, densify=due)

    def after_step(self, at: Iteration) -> None:
        """Densify where that is due: remove useless Gaussians, split others up to the next count, fade opacities.

        Before the window's start, useless Gaussians are removed, and nothing else changes.
        """
        if not at.density.densify:
            return
        grows = self._grows(at.iteration)
        aim = now = self._gaussians.gaussian_count
        if grows:
            aim = self._next_count(now, at.iteration)
        remove_useless(self._gaussians, self._opt.prune_opacity, max(aim, 1))
        refuse_empty(at.iteration, self._gaussians.gaussian_count == 0, "lower --prune_opacity")
        if grows:
            if aim > self._gaussians.gaussian_count:
                split_in_two(self._gaussians, self._choose_parents(at, aim - self._gaussians.gaussian_count))
            fade(self._gaussians, self._opt.opacity_decay)
        sort_rows(self._gaussians)

    def _next_count(self, now: int, iteration: int) -> int:
        """Return the number of Gaussians to have after the densification of an iteration.

        The number approaches the most in equal parts. This needs no state, and a run that fell behind catches up.

        now: number before the densification.
        """
        most = self.schedule.count_limit(iteration, now, self.max_gaussians, self.max_gaussians)
        remaining = self._count_remaining(iteration)
        return most - round((most - now) * (remaining / (remaining + 1)))

    def _grows(self, iteration: int) -> bool:
        return self.schedule.schedule_step(iteration) > self.window.start

    def _count_remaining(self, iteration: int) -> int:
        """Return the number of densifications after that of this iteration, at the iteration's stride."""
        stride = self.schedule.stride(iteration)
        left = self.window.end - self.schedule.schedule_step(iteration)
        ahead = left / (self.window.interval(stride) * stride)
        if stride != 1:
            ahead -= 0.5  # the stride changes, so one that just comes in time may not come
        return max(math.ceil(ahead) - 1, 0)

    def _choose_parents(self, at: Iteration, count: int) -> Tensor:
        """Return the indices of this process's Gaussians to split, ascending; `count` at most over all processes."""
        scores = self._scores(self._draw_views(at.iteration), at.background)
        numbers = {"seed": self._opt.seed, "stream": Stream.DENSIFY, "iteration": at.iteration}
        return self._gaussians.shards.choose(scores, count, **numbers)

    def _draw_views(self, iteration: int) -> list[Camera]:
        """Draw the training views whose errors score the Gaussians: SCORED_VIEWS, or fewer in a short run."""
        order = permutation(self._opt.seed, Stream.SCORED_VIEWS, iteration, len(self._cameras))
        count = SCORED_VIEWS
        if (stride := self.schedule.stride(iteration)) > 1:  # few iterations, of which scores shall not take the time
            count = min(count, max(self.window.interval(stride) // ITERATIONS_A_SCORE, 1))
        return [self._cameras[index] for index in order[:count]]
