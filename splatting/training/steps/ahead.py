"""Steps of a host that runs ahead of its GPU (splatting/training/steps/run_ahead.py)."""

from contextlib import nullcontext

import torch

from splatting.training.objective import Losses
from splatting.training.observer import Announcer
from splatting.training.run import Run
from splatting.training.step import Step
from splatting.training.steps.fused import FusedStep
from splatting.training.steps.recorded import RecordedStep
from splatting.training.steps.run_ahead import RunAhead

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
        self._recorded = RecordedStep(run, self._fused, self._ahead.room)
        self._unknown = True  # whether somebody may have changed the model's tensors or hooks

    def take(self, step: Step, tell: Announcer) -> None:
        """Queue a step, unless something is due in it."""
        if step.due or not self._able(step):
            self._unknown = True
            self._ahead.settle()  # nothing is pending, unless --debug_from has just come into force
            self._run.set_rates(step)
            return self._fused.take(step, tell)
        losses: list[Losses] = []
        queued = self._ahead.take(
            _view(step),
            lambda: self._queue(step, losses),
            lambda: self._repeat(step, losses[0]),
            lambda: self._fused.measure(step),
        )
        if queued:
            return tell.measured(step, losses[0])
        self._run.set_rates(step)
        self._fused.plain.take(step, tell)

    def make_ready(self, step: Step) -> None:
        """Wait until few steps are pending, or none if this one cannot be queued."""
        if step.due or not self._able(step):
            self._ahead.settle()
            self._recorded.make_room()
        else:
            self._ahead.make_way()

    def settle(self) -> None:
        """Wait until all steps are done."""
        self._ahead.settle()

    def give_up(self) -> int:
        """Take back the steps that cannot be done, after an error. Returns their number."""
        return self._ahead.give_up()

    def _able(self, step: Step) -> bool:
        """Whether the step can be queued.

        The model is asked after each step in which something was due: only there may somebody replace its tensors, or
        wait for gradients.
        """
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

    def _queue(self, step: Step, losses: list[Losses]) -> bool:
        """Queue a step and append its losses, unless its loss has further terms."""
        taken = self._recorded.take(step)
        if taken is None:
            with self._ahead.room(_view(step)):
                taken = self._queue_calls(step)
        else:
            density = self._run.density
            with self._ahead.room(_view(step)) if density.queues else nullcontext():
                density.after_step(step)
        if taken is not None:
            losses.append(taken)
        return taken is not None

    def _queue_calls(self, step: Step) -> Losses | None:
        drawn, losses, gradients = self._fused.measure(step)
        if self._fused.finds_further_terms():
            return None
        self._run.gaussians.guard_loss(step.iteration, losses.total)
        self._fused.advance(step, drawn, gradients)
        return losses

    @torch.no_grad()
    def _copy(self, repeated: Losses, first: Losses) -> None:
        for new, old in zip(repeated[:3], first[:3], strict=True):
            if old is not None:
                old.detach().copy_(new)

    def _repeat(self, step: Step, first: Losses) -> None:
        """Queue a step once more; the losses that the observers hold get its values."""
        self._run.set_rates(step)
        losses: list[Losses] = []
        self._queue(step, losses)
        self._copy(losses[0], first)


def _view(step: Step) -> tuple[int, int]:
    """What the room that a step needs depends on."""
    return step.camera.uid, step.camera.image_width
