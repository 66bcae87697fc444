"""The tab that controls a training and shows how it goes."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from viewing.in_turn import in_turn
from viewing.requests import Requests

if TYPE_CHECKING:
    import viser

_NO_CURVE = "There is no curve yet: it needs test views (`--eval`), and two scorings of them."


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
        self.pause.on_click(in_turn(lambda _: self._turn()))
        step.on_click(in_turn(lambda _: (requests.step(), self._label())))
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
