"""Steps of a host that runs ahead of its GPU (training/steps/run_ahead.py)."""

import torch

from training.objective import Losses
from training.observer import Announcer
from training.run import Run
from training.step import Step
from training.steps.fused import FusedStep
from training.steps.recorded import RecordedStep
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
        self._ahead = RunAhead(run.device, (room, max(_SLOTS * count, _LEAST), room), self._rewind)
        self._recorded = RecordedStep(run, self._ahead.room)
        self._unknown = True  # whether somebody may have changed the model's tensors or hooks

    def take(self, step: Step, tell: Announcer) -> None:
        """Queue a step, unless something is due in it."""
        if step.due or not self._able(step):
            self._unknown = True
            self._ahead.settle()  # nothing is pending, unless --debug_from has just come into force
            self._run.gaussians.update_learning_rate(step.iteration)
            return self._fused.take(step, tell)
        done: list[Losses] = []
        self._ahead.take(step.camera.uid, lambda: done.append(self._queue(step)), lambda: self._repeat(step, done[0]))
        tell.measured(step, done[0])

    def make_ready(self, step: Step) -> None:
        """Wait until few steps are pending, or none if this one cannot be queued."""
        if step.due or not self._able(step):
            self._ahead.settle()
        else:
            self._ahead.make_way()

    def settle(self) -> None:
        """Wait until all steps are done."""
        self._ahead.settle()

    def give_up(self) -> int:
        """Take back the steps that cannot be done, after an error. Returns their number."""
        return self._ahead.give_up()

    def _able(self, step: Step) -> bool:
        """Whether the step can be queued. The model is asked after each step in which somebody may have changed it."""
        if not self._fused.is_usual(step):
            return False
        if self._unknown:
            if not self._fused.takes(step):
                return False
            self._recorded.check()
            self._unknown = False
        return True

    def _rewind(self, steps: int) -> None:
        self._run.gaussians.rewind(steps)
        self._recorded.drop()

    def _queue(self, step: Step) -> Losses:
        losses = self._recorded.take(step)
        if losses is None:
            with self._ahead.room(step.camera.uid):
                losses = self._queue_calls(step)
        else:
            self._run.density.after_step(step)
        return losses

    def _queue_calls(self, step: Step) -> Losses:
        drawn, losses, gradients = self._fused.measure(step)
        fused = not self._fused.finds_further_terms()
        if not fused:
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
