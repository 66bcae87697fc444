"""The tab of a training, and the requests of the page's buttons, which are fulfilled between two iterations."""

import math
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from applications.viewer.tabs import serialize

if TYPE_CHECKING:
    import viser

_NO_CURVE = "There is no curve yet: it needs test views (`--eval`), and two scorings of them."


class Requests:
    """Requests of the page's buttons. Every method may be called from any thread.

    asked: called after each request.
    any: there is something to do.
    stopped: the training is to end, or without a training the page.
    """

    def __init__(self, asked: Callable[[], None]) -> None:
        """Start without requests. asked: called when one is made."""
        self._asked, self._lock = asked, threading.RLock()
        self._steps = self._checkpoints = 0
        self._jobs: list[Callable[[], object]] = []
        self.paused = self.stopped = False
        self.any = False  # read without the lock, in every iteration of a training

    def _set(self, **values: object) -> None:
        """Set attributes under the lock, and tell the page that something is asked for."""
        with self._lock:
            vars(self).update(values)
            self.any = self.paused or self._checkpoints > 0 or bool(self._jobs) or self.stopped
            self._asked()

    def _take_request(self, name: str) -> bool:
        """Count down the requests of a kind, if there are any; tell if there was one."""
        with self._lock:
            count = getattr(self, name)
            self._set(**{name: max(0, count - 1)})
        return count > 0

    def pause(self) -> None:
        """Wait after this iteration, until `resume` or `step`."""
        self._set(paused=True)

    def resume(self) -> None:
        """Go on, and forget steps that were asked for."""
        self._set(paused=False, _steps=0)

    def step(self) -> None:
        """Take one iteration, then wait. A training that is not paused waits after its next one."""
        with self._lock:
            self._set(_steps=self._steps + self.paused, paused=True)

    def save(self) -> None:
        """Save a checkpoint after this iteration."""
        self._set(_checkpoints=1)

    def ask(self, job: Callable[[], object]) -> None:
        """Call something that needs the model, once."""
        with self._lock:
            self._set(_jobs=self._jobs if job in self._jobs else [*self._jobs, job])

    def stop(self) -> None:
        """Save a checkpoint after this iteration, and end the training; without a training, close the page."""
        self._set(stopped=True)

    def take_step(self) -> bool:
        """Tell if a paused training may take one iteration; if so, the request counts as fulfilled."""
        return self._take_request("_steps")

    def take_checkpoint(self) -> bool:
        """Tell if a checkpoint is to be saved; if so, the request counts as fulfilled."""
        return self._take_request("_checkpoints")

    def work(self) -> None:
        """Do what needs the model. Called by the thread that changes it."""
        with self._lock:
            jobs = self._jobs
            self._set(_jobs=[])
        for job in jobs:
            job()

    def reset(self) -> None:
        """Forget what a training that is over was asked for, except for jobs."""
        self._set(paused=False, stopped=False, _steps=0, _checkpoints=0)


def format_duration(seconds: float) -> str:
    """Seconds for people: "34 s", "3 min 20 s", "2 h 5 min"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, part = divmod(minutes, 60)
    return f"{hours} h {part} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


class TrainingTab:
    """Buttons that make requests; iterations a second, time to go, loss, and the error against time."""

    def __init__(self, server: "viser.ViserServer", requests: Requests) -> None:
        """Put the controls into the current tab of the server."""
        gui = server.gui
        self._requests = requests
        self.speed = gui.add_text("Iterations per second", "", disabled=True)
        self.left = gui.add_text("Time to go", "", disabled=True)
        self.loss = gui.add_text("Loss", "", disabled=True)
        self.state = gui.add_markdown("", visible=False)
        self.pause, step = gui.add_button("Pause"), gui.add_button("One step")
        save, stop = gui.add_button("Save a checkpoint"), gui.add_button("Stop and save", color="red")
        self._buttons = self.pause, step, save, stop
        self.close = gui.add_button("Close the page", hint="ends the program that serves it", visible=False)
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
        self.pause.on_click(serialize(lambda _: self._toggle_pause()))
        step.on_click(serialize(lambda _: (requests.step(), self._update_label())))
        save.on_click(lambda _: requests.save())
        for end in (stop, self.close):
            end.on_click(lambda _: requests.stop())

    def begin_paused(self) -> None:
        """Let the training wait after its first iteration."""
        self._requests.pause()
        self._update_label()

    def _toggle_pause(self) -> None:
        (self._requests.resume if self._requests.paused else self._requests.pause)()
        self._update_label()

    def _update_label(self) -> None:
        self.pause.label = "Resume" if self._requests.paused else "Pause"

    def show(
        self,
        speed: float | None,
        left: float | None,
        loss: float,
        rows: Sequence[dict[str, float | None]],
        subset: float | None,
    ) -> None:
        """Show iterations a second, seconds to go (None: not known), the loss, and the curve's rows, of a subset.

        subset: how many test views these are, None for all.
        """
        self.speed.value = "" if speed is None else f"{speed:.3g}"
        self.left.value = "" if left is None else format_duration(left)
        self.loss.value = f"{loss:.5f}"
        if len(rows) != self._rows:
            self._rows = len(rows)
            points = [(row["seconds"], row["test_psnr"]) for row in rows if row.get("test_psnr") is not None]
            points = [point for point in points if all(map(math.isfinite, point))]
            if len(points) > 1:
                self.curve.data = tuple(np.array(values, dtype=np.float64) for values in zip(*points, strict=True))
                self.note.content = "" if subset is None else f"Points score {subset} of the test views."
                self.curve.visible, self.note.visible = True, subset is not None

    def end(self, text: str) -> None:
        """Show that the training is over. text: what came of it."""
        for shown in (*self._buttons, self.speed, self.left):
            shown.visible = False
        self.note.visible = self.note.visible and self.curve.visible
        self.state.content, self.state.visible, self.close.visible = text, True, True
