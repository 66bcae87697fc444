"""The share of its time that a training gives to the page."""

import time
from collections.abc import Callable

STILL = 0.15  # share of the time for frames while no camera moves
MOVING = 0.30  # while somebody moves one, or changes what is shown
_BETWEEN = 1 / 30  # seconds from frame to frame, at least


class Budget:
    """Says when the next frame may be drawn, so that drawing never takes more than a share of the time.

    After a frame that took c seconds, the next one waits until c is the wanted share of the time since that frame
    began. clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._began = -float("inf")
        self._cost = 0.0

    def allows(self, share: float) -> bool:
        """Whether a frame may begin now, if all of them may take `share` of the time."""
        return self._clock() - self._began >= max(self._cost / share, _BETWEEN)

    def spent(self, began: float, seconds: float) -> None:
        """Note a frame that began at `began` and took `seconds`."""
        self._began, self._cost = began, seconds

    def add(self, seconds: float) -> None:
        """Add what was spent on the last frame later, as for its JPEG."""
        self._cost += seconds
