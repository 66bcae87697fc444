"""The tab that controls a training and shows how it goes, and the requests that its buttons make."""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from splatting.viewer.tabs import serialized

if TYPE_CHECKING:
    import viser

_NO_CURVE = "There is no curve yet: it needs test views (`--eval`), and two scorings of them."


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

    @contextmanager
    def _changing(self) -> Iterator[None]:
        with self._lock:
            yield
            self.any = self.paused or self._checkpoint or self.stopped
            self._asked()

    def pause(self) -> None:
        """Wait after this iteration, until `resume` or `step`."""
        with self._changing():
            self.paused = True

    def resume(self) -> None:
        """Go on, and forget steps that were asked for."""
        with self._changing():
            self.paused, self._steps = False, 0

    def step(self) -> None:
        """Take one iteration, then wait. A training that is not paused waits after its next one."""
        with self._changing():
            self._steps += self.paused
            self.paused = True

    def save(self) -> None:
        """Save a checkpoint after this iteration."""
        with self._changing():
            self._checkpoint = True

    def stop(self) -> None:
        """Save a checkpoint after this iteration, and end."""
        with self._changing():
            self.stopped = True

    def take_step(self) -> bool:
        """Whether a paused training may take one iteration; if so, that request is fulfilled."""
        with self._changing():
            taken = self._steps > 0
            self._steps -= taken
        return taken

    def take_checkpoint(self) -> bool:
        """Whether to save a checkpoint; if so, that request is fulfilled."""
        with self._changing():
            taken, self._checkpoint = self._checkpoint, False
        return taken


class TrainingTab:
    """Buttons that make requests; iterations a second, loss, and the error against time."""

    def __init__(self, server: "viser.ViserServer", requests: Requests) -> None:
        gui = server.gui
        self._requests = requests
        self.speed = gui.add_text("Iterations a second", "", disabled=True)
        self.loss = gui.add_text("Loss", "", disabled=True)
        self.pause, step = gui.add_button("Pause"), gui.add_button("One step")
        save, stop = gui.add_button("Save a checkpoint"), gui.add_button("Stop and save", color="red")
        self.note = gui.add_markdown(_NO_CURVE)
        axes = ({"label": "seconds of training"}, {"label": "test PSNR (dB)"})
        self.curve = gui.add_uplot(
            (np.zeros(1), np.zeros(1)),
            ({"label": "seconds"}, {"label": "PSNR", "stroke": "#1c7ed6", "width": 2, "points": {"show": True}}),
            scales={"x": {"time": False}},
            axes=axes,
            aspect=1.4,
            visible=False,
        )
        self._rows = 0
        self.pause.on_click(serialized(lambda _: self._turn()))
        step.on_click(serialized(lambda _: (requests.step(), self._label())))
        save.on_click(lambda _: requests.save())
        stop.on_click(lambda _: requests.stop())

    def _turn(self) -> None:
        (self._requests.resume if self._requests.paused else self._requests.pause)()
        self._label()

    def _label(self) -> None:
        self.pause.label = "Resume" if self._requests.paused else "Pause"

    def show(self, speed: float | None, loss: float, rows: Sequence[dict[str, float | None]]) -> None:
        """Show iterations a second (None: not known), the loss, and the curve's rows so far."""
        self.speed.value = "" if speed is None else f"{speed:.3g}"
        self.loss.value = f"{loss:.5f}"
        if len(rows) != self._rows:
            self._rows = len(rows)
            points = [(row["seconds"], row["test_psnr"]) for row in rows if row.get("test_psnr") is not None]
            points = [point for point in points if all(map(math.isfinite, point))]
            if len(points) > 1:
                self.curve.data = tuple(np.array(values, dtype=np.float64) for values in zip(*points, strict=True))
                self.curve.visible, self.note.visible = True, False
