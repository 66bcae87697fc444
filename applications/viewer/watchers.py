"""Order of drawing: the browsers that watch, the next frame for one of them, and a training's share of time for it."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from applications.viewer.views import Pose

STILL = 0.15  # share of the time for frames while no camera moves
MOVING = 0.30  # while somebody moves one, or changes what is shown
_BETWEEN = 1 / 30  # seconds from frame to frame, at least
STILL_AFTER = 0.25  # seconds without a movement


class Budget:
    """Says when the next frame may be drawn, so that drawing never takes more than a share of the time.

    After a frame that took c seconds, the next one waits until c is the requested share of the time since that frame
    began. clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._began = -float("inf")
        self._cost = 0.0

    def allows_frame(self, share: float) -> bool:
        """Tell if a frame may begin now, where all frames may take `share` of the time."""
        return self._clock() - self._began >= max(self._cost / share, _BETWEEN)

    def note_frame(self, began: float, seconds: float) -> None:
        """Note a frame that began at `began` and took `seconds`."""
        self._began, self._cost = began, seconds


@dataclass
class Watcher:
    """A browser. asked: whether its last frame does not show a change. Times in seconds."""

    pose: Pose
    moved: float
    asked: bool
    sharp: bool = False  # whether its last frame had all pixels
    version: int = -1  # of the model, in its last frame
    drawn: float = -float("inf")


@dataclass(frozen=True)
class Wish:
    """A frame to draw. urgent: somebody waits for it."""

    client: int
    pose: Pose
    coarse: bool
    urgent: bool


class Watchers:
    """The browsers by their number. Every method may be called from any thread. clock: seconds."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._watchers: dict[int, Watcher] = {}
        self.any = False  # read without a lock, in every iteration of a training

    def update_browser(self, client: int, pose: Pose) -> None:
        """Note that a browser has come, that its camera has moved, or that its window has another size."""
        now = self._clock()
        with self._changed:
            known = self._watchers.get(client)
            if known is None:
                # The first image is one of a camera that stands still.
                self._watchers[client] = Watcher(pose, now - STILL_AFTER, True)
            elif pose != known.pose:
                known.pose, known.moved, known.asked = pose, now, True
            self.any = True
            self._changed.notify_all()

    def remove_browser(self, client: int) -> None:
        """Forget a browser that has gone."""
        with self._changed:
            self._watchers.pop(client, None)
            self.any = bool(self._watchers)
            self._changed.notify_all()

    def note_change(self, dragging: bool = False) -> None:
        """Note that the picture has changed for all browsers. dragging: by a slider, which may go on moving."""
        now = self._clock()
        with self._changed:
            for watcher in self._watchers.values():
                watcher.asked = True
                watcher.moved = now if dragging else watcher.moved
            self._changed.notify_all()

    def wake(self) -> None:
        """Let `wait` return."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Wait for a change, or for some seconds."""
        with self._changed:
            self._changed.wait(seconds)

    def next(self, version: int = 0) -> Wish | None:
        """The frame to draw next: of those that somebody waits for, the one whose browser had its last one first.

        version: of the model; one that has changed is shown to all whose cameras are still.
        """
        now = self._clock()
        with self._changed:
            wishes = [(w.drawn, self._make_wish(client, w, now, version)) for client, w in self._watchers.items()]
        wishes = [(not wish.urgent, drawn, wish.client, wish) for drawn, wish in wishes if wish is not None]
        return min(wishes)[-1] if wishes else None

    @staticmethod
    def _make_wish(client: int, watcher: Watcher, now: float, version: int) -> Wish | None:
        """Return the frame that a browser needs now, or None.

        now: seconds of the clock.
        version: of the model.
        """
        moving = now - watcher.moved < STILL_AFTER
        urgent = watcher.asked or not (moving or watcher.sharp)
        if urgent or not moving and watcher.version != version:
            return Wish(client, watcher.pose, moving, urgent)
        return None

    def note_drawing(self, wish: Wish, version: int = 0) -> None:
        """Note that a wish's frame is about to be drawn: changes from now on ask for another one."""
        with self._changed:
            watcher = self._watchers.get(wish.client)
            if watcher is not None:
                watcher.drawn = self._clock()
                watcher.sharp, watcher.version = not wish.coarse, version
                if watcher.pose == wish.pose:
                    watcher.asked = False
