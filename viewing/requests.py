"""Requests of the page to a training: pause, one step, a checkpoint, stop."""

import threading
from collections.abc import Callable


class Requests:
    """What the page's buttons have asked for. asked: called after each request.

    any: whether there is something to do in this iteration. Every method may be called from any thread.
    """

    def __init__(self, asked: Callable[[], None]) -> None:
        self._asked = asked
        self._lock = threading.Lock()
        self._steps = 0
        self._checkpoint = False
        self.paused = False
        self.stopped = False
        self.any = False  # read without the lock, in every iteration

    def _note(self) -> None:
        self.any = self.paused or self._checkpoint or self.stopped
        self._asked()

    def pause(self) -> None:
        """Wait after this iteration, until `resume` or `step`."""
        with self._lock:
            self.paused = True
            self._note()

    def resume(self) -> None:
        """Go on, and forget steps that were asked for."""
        with self._lock:
            self.paused, self._steps = False, 0
            self._note()

    def step(self) -> None:
        """Take one iteration, then wait. A training that is not paused waits after its next one."""
        with self._lock:
            self._steps += self.paused
            self.paused = True
            self._note()

    def save(self) -> None:
        """Save a checkpoint after this iteration."""
        with self._lock:
            self._checkpoint = True
            self._note()

    def stop(self) -> None:
        """Save a checkpoint after this iteration, and end."""
        with self._lock:
            self.stopped = True
            self._note()

    def take_step(self) -> bool:
        """Whether a paused training may take one iteration; if so, that request is fulfilled."""
        with self._lock:
            taken = self._steps > 0
            self._steps -= taken
            return taken

    def take_checkpoint(self) -> bool:
        """Whether to save a checkpoint; if so, that request is fulfilled."""
        with self._lock:
            taken, self._checkpoint = self._checkpoint, False
            self._note()
            return taken
