"""The tabs of the page: what is drawn, the scene's cameras, a recorded camera path, and the training.

The training's buttons make requests, which the training fulfils between two iterations.
"""

import contextlib
import math
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from splatting.camera_paths.keyframes import EASINGS, CameraPath, Keyframe
from splatting.viewer.views import (
    COMPARISONS,
    MODES,
    SceneCameras,
    Settings,
    Vector,
    as_utf8,
    fov_of_canvas,
    pose_of,
    window_of,
)
from utils.graphics_utils import camera_center
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

_MOST_SCALING = 2.0  # scaling modifier
_OUTLIERS = 0.02  # quantile of the positions at which the crop box begins
_MOST = 200  # cameras that are drawn
_COLOURS = {"train": (60, 120, 220), "test": (220, 100, 40)}
_DRAWN_SIZE = 0.06  # of a drawn camera, by the scene's size
FOLDER = "camera_paths"  # in the model's folder
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_LONGEST_WAIT = 3600.0  # seconds between keyframes
_NO_CURVE = "There is no curve yet: it needs test views (`--eval`), and two scorings of them."


def serialized(call: Callable[[Any], object]) -> Callable[[Any], Any]:
    """A coroutine for a call, because viser runs those one after the other, and plain functions in many threads."""

    async def called(event: Any) -> None:
        call(event)

    return called


class ViewTab:
    """Controls for mode, scaling modifier, SH degree, background and crop box.

    changed: called when one of them moves. positions: (N, 3) of the Gaussians, for a first crop box.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        changed: Callable[[], None],
        positions: Tensor,
        sh_degree: int,
        background: Vector,
    ) -> None:
        gui, self._scene = server.gui, server.scene
        self.mode = gui.add_dropdown("Show", MODES)
        self.scaling = gui.add_slider("Scaling modifier", 0.01, _MOST_SCALING, 0.01, 1.0)
        self.degree = gui.add_slider("SH degree", 0, max(sh_degree, 1), 1, sh_degree, disabled=sh_degree == 0)
        self.background = gui.add_rgb("Background", tuple(round(255 * x) for x in background))
        low, high = first_box(positions)
        self.crop = gui.add_checkbox("Crop box", False, hint="Gaussians outside are not drawn; the model stays whole")
        longest = max(b - a for a, b in zip(low, high, strict=True))
        step = 10.0 ** math.floor(math.log10(max(longest, 1e-6) / 100))
        self.corners = [gui.add_vector3(f"Corner {n}", at, step=step) for n, at in ((1, low), (2, high))]
        self._box = None
        for handle in (self.mode, self.scaling, self.degree, self.background):
            handle.on_update(lambda _: changed())
        for handle in (self.crop, *self.corners):
            handle.on_update(serialized(lambda _: (self._show_box(), changed())))

    def _show_box(self) -> None:
        """Draw the edges of the crop box into the scene."""
        if self._box is not None:
            self._box.remove()
            self._box = None
        if self.crop.value:
            one, other = (torch.tensor(corner.value) for corner in self.corners)
            size, middle = (other - one).abs().tolist(), ((one + other) / 2).tolist()
            self._box = self._scene.add_box("/crop box", (255, 160, 40), size, wireframe=True, position=middle)

    def read(self) -> Settings:
        """What the controls say. Numbers out of range count as the nearest that is in it."""
        scaling = self.scaling.value if math.isfinite(self.scaling.value) else 1.0
        box = tuple(corner.value for corner in self.corners) if self.crop.value else None
        return Settings(
            mode=self.mode.value,
            scaling=min(max(scaling, 0.0), _MOST_SCALING),
            sh_degree=max(self.degree.value, 0),
            background=tuple(min(max(x / 255, 0.0), 1.0) for x in self.background.value),
            crop=box,
        )


def first_box(positions: Tensor) -> tuple[Vector, Vector]:
    """A box around most positions (N, 3), rounded to thousandths of its size: its lowest and highest corner."""
    some = positions.detach()[:: max(1, len(positions) // 100_000)].double().cpu()
    some = some[some.isfinite().all(1)]
    if not len(some):
        return (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    low, high = (torch.quantile(some, q, dim=0) for q in (_OUTLIERS, 1 - _OUTLIERS))
    digits = 3 - math.floor(math.log10(max(float((high - low).max()), 1e-9)))
    return tuple(tuple(round(x, digits) for x in corner.tolist()) for corner in (low, high))


class ImagesTab:
    """Controls for the scene's cameras. changed(dragging): called when what is shown changes."""

    def __init__(self, server: "viser.ViserServer", changed: Callable[[bool], None], cameras: SceneCameras) -> None:
        gui, self._server, self._cameras = server.gui, server, cameras
        names = tuple(cameras.by_name)
        self.camera = gui.add_dropdown("Camera", names, hint="the view jumps there")
        again = gui.add_button("Go to the camera again")
        self.comparison = gui.add_dropdown(
            "Compare", COMPARISONS, hint="shown while the view is that of the chosen camera"
        )
        self.slider = gui.add_slider("Photo's share", 0.0, 1.0, 0.005, 0.5)
        shown = gui.add_checkbox("Draw cameras", False, hint="a click on one jumps there")
        self._drawn = server.scene.add_frame("/cameras", show_axes=False, visible=False)
        self._draw()
        # In turn, so that the view does not get its place from one camera and its direction from the next.
        self.camera.on_update(serialized(lambda event: self.go(event.client, self.camera.value)))
        again.on_click(serialized(lambda event: self.go(event.client, self.camera.value)))
        self.comparison.on_update(serialized(lambda event: (self.go(event.client, self.camera.value), changed(False))))
        self.slider.on_update(lambda _: changed(True))
        shown.on_update(lambda _: setattr(self._drawn, "visible", shown.value))

    def read(self, settings: Settings) -> Settings:
        """The settings, with what these controls say."""
        return replace(settings, camera=self.camera.value, comparison=self.comparison.value, slider=self.slider.value)

    def go(self, client: "viser.ClientHandle | None", name: str) -> None:
        """Move a browser's camera to one of the scene."""
        camera = self._cameras.by_name.get(name)
        if client is None or camera is None:
            return
        place, (width, height) = camera_center(camera.R, camera.T), window_of(client.camera)
        with client.atomic():
            with contextlib.suppress(ValueError):  # of a browser that says that it looks at its own place
                client.camera.position = place
            client.camera.look_at = place + camera.R[:, 2] * self._cameras.depth(camera)
            client.camera.up_direction = self._cameras.up_at(camera)
            client.camera.fov = fov_of_canvas(camera, width / height)

    def _draw(self) -> None:
        from viser.transforms import SO3

        names = list(self._cameras.by_name)
        for index, name in enumerate(names[:: -(-len(names) // _MOST) or 1]):
            camera = self._cameras.by_name[name]
            frustum = self._server.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=camera.FoVy,
                aspect=camera.image_width / camera.image_height,
                scale=_DRAWN_SIZE * self._cameras.size,
                color=_COLOURS[name.split()[0]],
                wxyz=SO3.from_matrix(np.asarray(camera.R)).wxyz,
                position=camera_center(camera.R, camera.T),
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(serialized(lambda event, name=name: self._choose(event.client, name)))

    def _choose(self, client: "viser.ClientHandle", name: str) -> None:
        self.camera.value = name
        self.go(client, name)


class PathTab:
    """Controls that add the browser's view as a keyframe, and save the path in the model's folder."""

    def __init__(self, server: "viser.ViserServer", model_path: Path) -> None:
        gui, self._folder = server.gui, Path(model_path) / FOLDER
        self.keyframes: list[Keyframe] = []
        self.seconds = gui.add_number("Seconds to the next", 2.0, min=0.1, max=_LONGEST_WAIT, step=0.1)
        add, remove = gui.add_button("Add this view"), gui.add_button("Remove the last")
        self.count = gui.add_text("Keyframes", "0", disabled=True)
        self.easing = gui.add_dropdown("Easing", EASINGS)
        self.name = gui.add_text("Name", self._free_name(), hint="letters, digits, - and _")
        save = gui.add_button("Save path")
        add.on_click(serialized(lambda event: self.add(event.client)))
        remove.on_click(serialized(lambda _: self.remove()))
        save.on_click(serialized(lambda event: self._save(event.client)))

    def add(self, client: "viser.ClientHandle") -> None:
        """Append the view of a browser, with what its window shows from top to bottom."""
        pose = pose_of(client.camera)
        if pose is None:
            return
        wait = self.seconds.value if math.isfinite(self.seconds.value) else 0.1
        seconds = self.keyframes[-1].seconds + min(max(wait, 0.1), _LONGEST_WAIT) if self.keyframes else 0.0
        self.keyframes.append(Keyframe(round(seconds, 3), pose.position, pose.wxyz, math.degrees(pose.fov)))
        self.count.value = str(len(self.keyframes))

    def remove(self) -> None:
        """Remove the last keyframe, if there is one."""
        del self.keyframes[-1:]
        self.count.value = str(len(self.keyframes))

    def save(self, name: str) -> Path:
        """Write the path as camera_paths/NAME.json of the model's folder. UserError for what cannot be written."""
        if not _NAME.fullmatch(name):
            raise UserError("the name of a path has 1 to 64 letters, digits, - and _; choose another one")
        if len(self.keyframes) < 2:
            raise UserError(f"a path needs at least 2 keyframes, this one has {len(self.keyframes)}; add views")
        easing = self.easing.value if self.easing.value in EASINGS else EASINGS[0]
        file = self._folder / f"{name}.json"
        CameraPath(tuple(self.keyframes), easing).write(file)
        return file

    def _save(self, client: "viser.ClientHandle | None") -> None:
        try:
            title, body = "Saved", f"render.py -m {self._folder.parent} --path {self.save(self.name.value)}"
        except UserError as error:
            title, body = "Not saved", str(error)
        if client is not None:
            client.add_notification(title, as_utf8(body))

    def _free_name(self) -> str:
        number = 1
        while (self._folder / f"path{number}.json").exists():
            number += 1
        return f"path{number}"


class Requests:
    """What the page's buttons have asked for. asked: called after each request.

    any: whether there is something to do in this iteration. Every method may be called from any thread.
    """

    def __init__(self, asked: Callable[[], None]) -> None:
        self._asked, self._lock = asked, threading.RLock()
        self._steps, self._checkpoints = 0, 0
        self.paused = self.stopped = False
        self.any = False  # read without the lock, in every iteration

    def _set(self, **values: object) -> None:
        with self._lock:
            vars(self).update(values)
            self.any = self.paused or self._checkpoints > 0 or self.stopped
            self._asked()

    def _take(self, name: str) -> bool:
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

    def stop(self) -> None:
        """Save a checkpoint after this iteration, and end."""
        self._set(stopped=True)

    def take_step(self) -> bool:
        """Whether a paused training may take one iteration; if so, that request is fulfilled."""
        return self._take("_steps")

    def take_checkpoint(self) -> bool:
        """Whether to save a checkpoint; if so, that request is fulfilled."""
        return self._take("_checkpoints")


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
