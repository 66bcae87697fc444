"""Tells the parts of a training what happens in it."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType

from splatting.part import Error, Part, overrides
from splatting.training.iteration import Iteration, Losses


class Announcer:
    """Calls the hooks of parts, in the order of the list. Inside `with`, an error is told to `ended`."""

    def __init__(self, parts: Sequence[Part], look: Callable[[], AbstractContextManager] = nullcontext) -> None:
        """look: within it, parts are told of an iteration in which they read the model."""
        self._look = look
        self._begins, self._measured, self._stepped, self._ended = (
            overrides(parts, hook) for hook in ("begins", "measured", "stepped", "ended")
        )
        self._due = [(due, due.__self__.reads_model) for due in overrides(parts, "due")]

    def begins(self, at: Iteration) -> None:
        # A list, so that each part is asked in every iteration, whatever the others answer.
        due = [(due(at), reads) for due, reads in self._due]
        at.due = at.changes or any(is_due for is_due, _ in due)
        at.read = any(is_due and reads for is_due, reads in due)
        for notify in self._begins:
            notify(at)

    def measured(self, at: Iteration, losses: Losses) -> None:
        with self._look() if at.read else nullcontext():
            for notify in self._measured:
                notify(at, losses)

    def stepped(self, at: Iteration) -> None:
        with self._look() if at.read or at.stopping else nullcontext():
            for notify in self._stepped:
                notify(at)

    def ended(self, error: Error = None) -> None:
        for notify in self._ended:
            notify(error)

    def __enter__(self) -> "Announcer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Error, trace: TracebackType | None) -> None:
        if error is not None:
            self.ended(error)
