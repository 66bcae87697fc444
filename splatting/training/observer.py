"""Observers of a training. Each overrides the hooks that it needs; the loop calls no others."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import ClassVar, TypeAlias

from splatting.training.iteration import Iteration
from splatting.training.objective import Losses

Error: TypeAlias = BaseException | None


class Observer:
    """Base of all observers. A hook that a class does not override costs nothing.

    reads_model: whether it reads the model where it is due. Blocks that sleep are brought up to date for that.
    """

    reads_model: ClassVar[bool] = True

    def due(self, step: Iteration) -> bool:
        """Whether this iteration reads the model or a loss, or writes something. Asked once, when it begins.

        If so, all steps before it are done by then, and every loss so far is checked first in `measured`. Otherwise the
        GPU may be some steps behind in `measured` and `stepped`, so what these get must not be read, only noted.
        """
        raise NotImplementedError

    def begins(self, step: Iteration) -> None:
        """The iteration begins, with its view."""

    def measured(self, step: Iteration, losses: Losses) -> None:
        """The losses are computed. If the iteration is due, the model is still the one that was rendered."""

    def stepped(self, step: Iteration) -> None:
        """Density control and optimiser are done; the model is that of the next iteration."""

    def ended(self, error: Error) -> None:
        """Training is over: after its last iteration (None), or by an error, which may be replaced by raising."""


class Announcer:
    """Calls the hooks of observers, in the order of the list. Inside `with`, an error is told to `ended`."""

    def __init__(self, observers: Sequence[Observer], look: Callable[[], AbstractContextManager] = nullcontext) -> None:
        """look: within it, observers are told of an iteration in which they read the model."""
        self._look = look

        def overridden(hook: str) -> list:
            plain = getattr(Observer, hook)
            return [getattr(one, hook) for one in observers if getattr(type(one), hook) is not plain]

        self._begins, self._measured, self._stepped, self._ended = map(
            overridden, ("begins", "measured", "stepped", "ended")
        )
        self._due = [(due, due.__self__.reads_model) for due in overridden("due")]

    def begins(self, step: Iteration) -> None:
        # A list, so that each observer is asked in every iteration, whatever the others answer.
        due = [(due(step), reads) for due, reads in self._due]
        step.due = step.changes or any(is_due for is_due, _ in due)
        step.read = any(is_due and reads for is_due, reads in due)
        for notify in self._begins:
            notify(step)

    def measured(self, step: Iteration, losses: Losses) -> None:
        with self._look() if step.read else nullcontext():
            for notify in self._measured:
                notify(step, losses)

    def stepped(self, step: Iteration) -> None:
        with self._look() if step.read or step.stopping else nullcontext():
            for notify in self._stepped:
                notify(step)

    def ended(self, error: Error = None) -> None:
        for notify in self._ended:
            notify(error)

    def __enter__(self) -> "Announcer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Error, trace: TracebackType | None) -> None:
        if error is not None:
            self.ended(error)
