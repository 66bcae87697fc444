"""Losses and scores as events for TensorBoard, where the package is installed."""

import argparse
from typing import Any

import torch

from splatting import events
from splatting.iteration import Iteration, Losses
from splatting.part import Part
from splatting.scores import training_report


class Tensorboard(Part):
    """Writes the losses of every tenth iteration, except testing ones, in which `training_report` writes them."""

    name = "tensorboard"

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        return True

    def opened(self, run: Any) -> None:
        self._run = run
        self._writes = run.writer is not None and run.report is training_report
        self._kept: list[tuple] = []
        if run.writer is not None:
            run.resources.callback(run.writer.close)

    def measured(self, at: Iteration, losses: Losses) -> None:
        if not self._writes:
            return
        if at.iteration % events.INTERVAL == 0 and not at.takes(self._run.launch.test_iterations):
            self._kept.append((at.iteration, losses.l1, losses.total, self._run.clock.seconds - at.started))
        if at.due and self._kept:
            with self._run.clock.paused("scoring"):
                self._write()

    def _write(self) -> None:
        """Write the losses that are kept, and wait for the GPU once, not once for each loss."""
        kept, self._kept = self._kept, []
        values = torch.stack([loss.detach() for _, *pair, _ in kept for loss in pair]).cpu().view(-1, 2)
        for (iteration, *_, seconds), (l1, total) in zip(kept, values, strict=True):
            events.Events(self._run.writer, iteration).losses(l1, total, seconds)
