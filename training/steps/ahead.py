"""Steps of a host that runs ahead of its GPU (training/steps/run_ahead.py)."""

import torch

from training.objective import Losses
from training.observer import Announcer
from training.run import Run
from training.step import Step
from training.steps.fused import FusedStep
from training.steps.run_ahead import RunAhead

_INSTANCES = 8  # of a Gaussian, for the room of the first step
_SLOTS = 16
_LEAST = 1 << 16


class AheadStep:
    """Takes steps as `FusedStep` does, but does not wait for the GPU unless something reads or changes the model.

    An error leaves the model as it was after the last step that was done.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._fused = FusedStep(run)
        count = len(run.gaussians)
        room = max(_INSTANCES * count, _LEAST)
        self._ahead = RunAhead(run.device, (room, max(_SLOTS * count, _LEAST), room), run.gaussians.rewind)

    def take(self, step: Step, tell: Announcer) -> None:
        """Queue a step, unless something is due in it."""
        if step.due or not self._fused.takes(step):
            self.settle()
            return self._fused.take(step, tell)
        if self._fused.lazy.must_settle:
            self.settle()
        self._fused.let_rows_wait(step)
        done: list[Losses] = []
        self._ahead.take(step.camera.uid, lambda: done.append(self._queue(step)), lambda: self._repeat(step, done[0]))
        tell.measured(step, done[0])

    def settle(self) -> None:
        """Wait until all steps are done, and let all rows take those that they lack."""
        self._ahead.settle()
        self._fused.settle()

    def give_up(self) -> int:
        """Take back the steps that cannot be done, after an error. Returns their number."""
        lost = self._ahead.give_up()
        self._fused.settle()
        return lost

    def _queue(self, step: Step) -> Losses:
        drawn, losses, gradients = self._fused.measure(step)
        fused = not self._fused.finds_further_terms()
        if not fused:
            self._fused.lazy.catch_up()  # the rows stay lazy: a step before may be halted, and will be repeated
            package, losses = self._fused.plain.backward(step)
        self._run.gaussians.guard_loss(step.iteration, losses.total)
        if fused:
            self._fused.advance(step, drawn, gradients)
        else:
            self._fused.plain.advance(step, package)
        return losses

    @torch.no_grad()
    def _copy(self, repeated: Losses, first: Losses) -> None:
        for new, old in zip(repeated[:3], first[:3], strict=True):
            if old is not None:
                old.detach().copy_(new)

    def _repeat(self, step: Step, first: Losses) -> None:
        """Queue a step once more; the losses that the observers hold get its values."""
        self._run.gaussians.update_learning_rate(step.iteration)
        self._copy(self._queue(step), first)
