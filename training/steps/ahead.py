"""Steps of a host that runs ahead of its GPU (training/steps/run_ahead.py)."""

import torch

from training.objective import Losses
from training.observer import Announcer
from training.run import Run
from training.step import Step
from training.steps.plain import PlainStep
from training.steps.run_ahead import RunAhead

_INSTANCES = 8  # of a Gaussian, for the room of the first step
_SLOTS = 16
_LEAST = 1 << 16


class AheadStep:
    """Takes steps without waiting for the GPU, and as `PlainStep` does where something reads the model or changes it.

    An error leaves the model as it was after the last step that was done.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._plain = PlainStep(run)
        count = len(run.gaussians)
        room = max(_INSTANCES * count, _LEAST)
        self._ahead = RunAhead(run.device, (room, max(_SLOTS * count, _LEAST), room), run.gaussians.rewind)

    def take(self, step: Step, tell: Announcer) -> None:
        """Queue a step, unless something is due in it."""
        if step.due or step.last or self._run.pipe.debug:
            self._ahead.settle()
            self._plain.take(step, tell)
            return
        done: list[Losses] = []
        self._ahead.take(step.camera.uid, lambda: done.append(self._queue(step)), lambda: self._repeat(step, done[0]))
        tell.measured(step, done[0])

    def settle(self) -> None:
        """Wait until all steps are done."""
        self._ahead.settle()

    def give_up(self) -> int:
        """Take back the steps that cannot be done, after an error. Returns their number."""
        return self._ahead.give_up()

    def _queue(self, step: Step) -> Losses:
        package, losses = self._plain.backward(step)
        self._run.gaussians.guard_loss(step.iteration, losses.total)
        self._plain.advance(step, package)
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
