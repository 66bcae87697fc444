"""Blocks of Gaussians that sleep while no view shows them, and catch up when one may, with the same bytes."""

import argparse
from typing import Any

from scene import sleeping
from scene.fused_adam import FusedAdam
from scene.gaussians.adam import GaussianAdam
from scene.in_view import share_of
from scene.sleeping import Sleeping
from splatting.iteration import Iteration
from splatting.part import Part, fill


class Sleep(Part):
    """Lets blocks sleep where that saves something, and where a step concerns no row that its view does not see."""

    name = "sleep"

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        return True

    def begin(self, run: Any, state: Any) -> None:
        self._run, self._state = run, state

    def ready(self, run: Any) -> None:
        if self._saves():
            sleeping = Sleeping(run.gaussians)
            fill(run, "sleeping", sleeping, self)
            if self._state is not None:
                sleeping.restore(self._state)
        self._state = None  # it has rows of the model

    def _saves(self) -> bool:
        run, strategy = self._run, self._run.strategy
        dense = type(run.gaussians.optimizer) is GaussianAdam and FusedAdam.takes(run.gaussians)
        alone = not (strategy.queues or any(strategy.penalty))
        if not (dense and alone and run.is_standard):
            return False
        return (
            run.group.any_rank(run.gaussians.storage.limit > 0) or share_of(run.scene, run.device) < sleeping.MOST_SHARE
        )

    def after_step(self, at: Iteration) -> None:
        if (sleeping := self._run.sleeping) is None:
            return
        self._run.gaussians.optimizer.rows = None
        if at.changes:
            sleeping.reset()
        elif sleeping.flushes(at.iteration):
            sleeping.flush()
        else:
            sleeping.stepped()

    def state(self) -> Any:
        return self._run.sleeping and self._run.sleeping.captured()
