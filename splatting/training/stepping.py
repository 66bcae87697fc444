"""What a run does in each of its iterations: the view, the terms of the loss, the rates, and what follows the step."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from itertools import count
from typing import Any

import torch
from torch import Tensor

from splatting.deterministic.counter_rng import Stream, uniform
from splatting.host.clock import seconds_since_start
from splatting.part import Part, overrides
from splatting.training.iteration import Iteration, OwnSize


def bias_correction(step: int, beta1: float = 0.9, beta2: float = 0.999) -> float:
    """Factor of a step of Adam whose averages began at zero (Kingma and Ba 2015, Section 2), from 1/6 up to 1.

    Sparse Adam leaves it out, as the reference's. Steps that are long already would then be six times as long.
    """
    return math.sqrt(1 - beta2**step) / (1 - beta1**step)


SH_INTERVAL = 1000  # iterations between raises of the active SH degree


class Stepping:
    """The part of a run that its steps need.

    scene, gaussians, views (by iteration), objective, density, schedule; opt, pipe, launch: options; parts, and the
    slots that they fill (splatting/part.py); background: (3,) of the scene; first_iteration: done before this
    run. first_done: seconds from the process's start to the end of its first iteration; None: the system does not say.
    """

    first_done: float | None = None
    parts: Sequence[Part] = ()
    sleeping: Any = None
    sizes: Any = OwnSize()
    counts: Any = None
    on_host: Any = None

    @cached_property
    def _hooks(self) -> dict[str, list[Callable]]:
        return {}

    def each(self, hook: str) -> list[Callable]:
        """That hook of the parts that have it."""
        if hook not in self._hooks:
            self._hooks[hook] = overrides(self.parts, hook)
        return self._hooks[hook]

    @property
    def is_standard(self) -> bool:
        """Whether loss and density control need gradients of the image alone, and the kernels compute all the rest.

        What an objective or a strategy says of itself is not inherited; subclasses opt in.
        """
        own = all(vars(type(one)).get("fusable", False) for one in (self.objective, self.density))
        return own and not (self.pipe.compute_cov3D_python or self.pipe.convert_SHs_python)

    def iterations(self) -> Iterator[Iteration]:
        """The iterations of this run."""
        for iteration in count(self.first_iteration + 1):
            seconds, schedule = self.clock.seconds, self.schedule
            schedule.reach(iteration, self.log.seconds_before + seconds)
            camera = self.sizes.view(self.views[iteration], schedule.schedule_step(iteration))
            span, last = schedule.span(iteration), schedule.is_last(iteration)
            step = Iteration(
                iteration,
                last=last,
                rests=schedule.rests(iteration),
                camera=camera,
                background=self._background(iteration),
                changes=self._changes(iteration),
                started=seconds,
                span=range(span.start, schedule.length + 1) if last else span,
            )
            self.add_terms(step)
            yield step
            if iteration == self.first_iteration + 1:
                self.first_done = seconds_since_start()
            if step.last:
                return

    def add_terms(self, step: Iteration) -> None:
        """Add what parts add to the loss of a step."""
        for terms in self.each("terms"):
            if found := terms(step):
                step.terms |= found
                step.wants_depth |= terms.__self__.needs.depth
                step.captured &= terms.__self__.needs.captured

    def _changes(self, iteration: int) -> bool:
        changes = any(changes(iteration) for changes in self.each("changes"))
        return self._raises_degree(iteration) > 0 or changes

    def _raises_degree(self, iteration: int) -> int:
        """How often the SH degree is raised in an iteration."""
        before, now = (self.schedule.schedule_step(t) // SH_INTERVAL for t in (iteration - 1, iteration))
        return now - before

    def _background(self, iteration: int) -> Tensor:
        if not self.opt.random_background:
            return self.background
        draws = uniform(self.opt.seed, Stream.BACKGROUND, iteration, torch.zeros(1, dtype=torch.int64))
        return draws[0, :3].to(self.device)

    def prepare(self, step: Iteration) -> None:
        """Set learning rates and SH degree, and begin to decode the photos of the next views."""
        self.set_rates(step)
        for _ in range(self._raises_degree(step.iteration)):
            self.gaussians.oneupSHdegree()
            self.gaussians.limit_columns()
        if step.iteration - 1 == self.launch.debug_from:
            self.pipe.debug = True
        self.decode_ahead(step.iteration)

    def set_rates(self, step: Iteration) -> None:
        """Set the learning rates of a step, which may be one that is repeated."""
        self.gaussians.exposures.held = self.density.recovers(step.iteration)
        self.gaussians.update_learning_rate(self.schedule.schedule_step(step.iteration))
        factor = self.schedule.rate_factor(step.iteration)
        if factor is None:
            factor = self.density.rate_factor(step.iteration)
        if factor is not None:
            sparse = self.opt.optimizer_type == "sparse_adam"
            self.gaussians.scale_rates(factor * (bias_correction(step.iteration) if sparse else 1.0))

    def decode_ahead(self, iteration: int) -> None:
        """Begin to decode the photos of an iteration and of those that follow it."""
        ahead = self.scene.images.ahead
        if (last := self.schedule.ends) is not None:
            ahead = min(ahead, last - iteration + 1)
        self.scene.prefetch(list(filter(self.sizes.needs, self.views.coming(iteration, ahead))))

    def step_on_host(self, step: Iteration, gradient: Tensor) -> None:
        """Take the step of the view's camera. gradient (numbers,): of the loss by the camera's numbers."""
        at = self.schedule.schedule_step(step.iteration)
        self.on_host.step(step.camera.uid, gradient.cpu().numpy(), at)
        self.on_host.place()

    def after_step(self, step: Iteration) -> None:
        """What follows the optimiser's step."""
        for after_step in self.each("after_step"):
            after_step(step)
        if step.changes:
            for after_change in self.each("after_change"):
                after_change(step)

    def flushed_view(self) -> AbstractContextManager:
        """Within it, others may read the model."""
        return nullcontext() if self.sleeping is None else self.sleeping.flushed_view()

    def stop_skipping(self) -> None:
        """Let all blocks take the steps that they have missed, and sleep no more."""
        if self.sleeping is not None:
            self.sleeping.flush()
        self.sleeping = None

    def render_options(self, step: Iteration) -> dict[str, bool]:
        """Options of `render` that make it compute what this step's loss needs, and no more."""
        return {
            "use_trained_exp": self.gaussians.exposures.applied,
            "want_depth": step.wants_depth,
            "want_visibility": False,
            "want_inactive_bands": False,
            "want_absolute_gradient": self.density.absolute_gradients and self.density.observes(step.iteration),
            "clamp": False,
        }
