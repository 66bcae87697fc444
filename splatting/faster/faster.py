"""Interface of the faster forms of the plain step (splatting/loop.py): the same bytes, sooner."""

from typing import Protocol

from splatting.iteration import Iteration, Losses


class Tell(Protocol):
    """Receiver of the losses of a step, for observers."""

    def measured(self, at: Iteration, losses: Losses) -> None: ...


class FasterSteps:
    """Takes steps faster than `plain_step`, with the same bytes. This base takes none, and leaves nothing pending."""

    def take(self, at: Iteration, tell: Tell) -> bool:
        """Take a step, and tell observers when its loss is known. Return False for one that `plain_step` must take."""
        return False

    def throttle(self, at: Iteration) -> None:
        """Wait until another step may be queued on a GPU."""

    def drain(self) -> None:
        """Wait until all steps are done."""

    def abort(self) -> None:
        """Wait, after an error, until the GPU has stopped."""
