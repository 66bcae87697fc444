"""The tabs of the page that say what is drawn, and the scene's cameras."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from splatting.camera_paths.poses import opening
from splatting.camera_paths.start import narrowed
from splatting.viewer import views
from splatting.viewer.frusta import Frusta
from splatting.viewer.views import SceneCameras, Settings, Vector
from utils.graphics_utils import camera_center
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

_MOST_SCALING = 2.0  # scaling modifier
_OUTLIERS = 0.02  # quantile of the positions at which the crop box begins
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


Tell = Callable[["viser.ClientHandle", UserError], None]


def serialized(call: Callable[[Any], object], tell: Tell | None = None) -> Callable[[Any], Any]:
    """A coroutine for a call, because viser runs those one after the other, and plain functions in many threads.

    tell: called with the browser and a UserError of the call.
    """

    async def called(event: Any) -> None:
        try:
            call(event)
        except UserError as error:
            if tell is None:
                raise
            tell(event.client, error)

    return called


class FileName:
    """A field with the name of a file. Whatever a browser sends, the file lies in the folder and has the ending."""

    def __init__(self, server: "viser.ViserServer", folder: Path, first: str, ending: str) -> None:
        self.folder, self._first, self._ending = folder, first, ending
        self._suggested = self._free()
        self.field = server.gui.add_text("Name", self._suggested, hint="letters, digits, - and _")

    def _free(self) -> str:
        number = 1
        while (self.folder / f"{self._first}{number}{self._ending}").exists():
            number += 1
        return f"{self._first}{number}"

    def suggest(self) -> None:
        """Put the next free name in the place of the one that was suggested before, but not of one that was typed."""
        if self.field.value == self._suggested:
            self.field.value = self._suggested = self._free()

    def path(self) -> Path:
        """The file. UserError for a name that is none."""
        if not _NAME.fullmatch(self.field.value):
            raise UserError("a name has 1 to 64 letters, digits, - and _; choose another one")
        return self.folder / f"{self.field.value}{self._ending}"

    def replaced(self) -> str:
        """What there is to say of a file that is written now, if there is one already."""
        return " (replaced)" if self.path().exists() else ""

    def names(self) -> tuple[str, ...]:
        """Names of the files that are there."""
        return tuple(sorted(file.stem for file in self.folder.glob(f"*{self._ending}") if _NAME.fullmatch(file.stem)))


class ViewTab:
    """Controls for mode, scaling modifier, SH degree, background, cleaning and crop box.

    changed: called when one of them moves. export: called when the crop box is to be written. folder: for its files.
    positions: (N, 3) of the Gaussians, for a first crop box. cleaned: whether it is known what cleaning leaves.
    photos: whether there are any, to show errors.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        changed: Callable[[], None],
        export: Callable[[], None],
        folder: Path,
        positions: Tensor,
        sh_degree: int,
        background: Vector,
        cleaned: bool,
        photos: bool,
    ) -> None:
        gui, self._scene = server.gui, server.scene
        self.mode = gui.add_dropdown("Show", views.MODES if photos else views.MODES[: views.MODES.index(views.ERROR)])
        self.background = gui.add_rgb("Background", tuple(round(255 * x) for x in background))
        self.cleaning = gui.add_dropdown(
            "Cleaning", views.CLEANINGS, visible=cleaned, hint="what export.py --clean does"
        )
        self.crop = gui.add_checkbox("Crop box", False, hint="Gaussians outside are not drawn; the model stays whole")
        low, high = first_box(positions)
        longest = max(b - a for a, b in zip(low, high, strict=True))
        step = 10.0 ** math.floor(math.log10(max(longest, 1e-6) / 100))
        self.box = [gui.add_vector2(f"{x} from, to", at, step=step) for x, *at in zip("xyz", low, high, strict=True)]
        self.crop_file = FileName(server, folder, "crop", ".ply")
        written = gui.add_button("Export the crop", hint="writes its Gaussians, whatever else is set here")
        with gui.add_folder("Advanced", expand_by_default=False):
            hint = "size of Gaussians as drawn; the model keeps its own"
            self.scaling = gui.add_slider("Scaling modifier", 0.01, _MOST_SCALING, 0.01, 1.0, hint=hint)
            hint = "how much colours change with the direction that they are seen from"
            last = max(sh_degree, 1)
            self.degree = gui.add_slider("SH degree", 0, last, 1, sh_degree, hint=hint, visible=sh_degree > 0)
        self.reset = gui.add_button("Reset", color="gray", hint="everything in this tab", disabled=True)
        self._of_crop = *self.box, self.crop_file.field, written
        self._edges = None
        self._show_box()
        drawn = self.mode, self.scaling, self.degree, self.background, self.cleaning
        shown = *drawn, self.crop, *self.box
        self._first = [(handle, handle.value) for handle in shown]
        for handle in drawn:
            handle.on_update(lambda _: (self._grey(), changed()))
        for handle in (self.crop, *self.box):
            handle.on_update(serialized(lambda _: (self._show_box(), self._grey(), changed())))
        written.on_click(lambda _: export())
        self.reset.on_click(serialized(lambda _: self._reset()))

    def _grey(self) -> None:
        self.reset.disabled = all(handle.value == value for handle, value in self._first)

    def _reset(self) -> None:
        for handle, value in self._first:
            handle.value = value

    def _show_box(self) -> None:
        """Draw the edges of the crop box into the scene, and show the controls that it needs."""
        if self._edges is not None:
            self._edges.remove()
            self._edges = None
        for handle in self._of_crop:
            if handle.visible != self.crop.value:
                handle.visible = self.crop.value
        if self.crop.value:
            one, other = torch.tensor(self.corners())
            size, middle = (other - one).abs().tolist(), ((one + other) / 2).tolist()
            self._edges = self._scene.add_box("/crop box", (255, 160, 40), size, wireframe=True, position=middle)

    def corners(self) -> tuple[Vector, Vector]:
        """Opposite corners of the crop box."""
        return tuple(zip(*(ends.value for ends in self.box), strict=True))

    def read(self) -> Settings:
        """What the controls say. Numbers out of range count as the nearest that is in it."""
        box = self.corners() if self.crop.value else None
        return Settings(
            mode=self.mode.value,
            scaling=min(max(self.scaling.value, 0.0), _MOST_SCALING),
            sh_degree=max(int(self.degree.value), 0),
            background=tuple(min(max(x / 255, 0.0), 1.0) for x in self.background.value),
            crop=box,
            cleaning=self.cleaning.value,
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
    """Controls for the scene's cameras. changed(dragging): called when what is shown changes.

    all_drawn: browsers begin with all cameras drawn and in view. photos: whether the cameras have any.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        changed: Callable[[bool], None],
        cameras: SceneCameras,
        all_drawn: bool,
        photos: bool,
    ) -> None:
        gui, self._server, self._cameras, self._all_drawn = server.gui, server, cameras, all_drawn
        self.frusta = Frusta(cameras, self._choose, all_drawn)
        names = tuple(cameras.by_name)
        self.camera = gui.add_dropdown(
            "Camera", names, initial_value=cameras.start or None, hint="the view jumps there"
        )
        again = gui.add_button("Go to the camera")
        hint = "shown while the view is that of the chosen camera" if photos else "there are no photos"
        self.comparison = gui.add_dropdown("Compare", views.COMPARISONS, hint=hint, disabled=not photos)
        self.slider = gui.add_slider("Slider", 0.0, 1.0, 0.005, 0.5, hint="0: render, 1: photo", visible=False)
        shown = gui.add_checkbox("Draw cameras", all_drawn, hint="a click on one jumps there; those near the view fade")
        colours = gui.add_markdown("Training views are blue, test views orange.", visible=all_drawn)
        self._windows: dict[int, tuple[int, int]] = {}  # of browsers, to which their opening angles fit
        self._begin()
        # In turn, so that the view does not get its place from one camera and its direction from the next.
        self.camera.on_update(serialized(lambda event: (self._begin(), self.go(event.client))))
        again.on_click(serialized(lambda event: self.go(event.client)))
        self.comparison.on_update(serialized(lambda event: (self._compare(event.client), changed(False))))
        self.slider.on_update(lambda _: changed(True))
        shown.on_update(serialized(lambda _: (self.frusta.show(shown.value), setattr(colours, "visible", shown.value))))

    def read(self, settings: Settings) -> Settings:
        """The settings, with what these controls say."""
        return replace(settings, camera=self.camera.value, comparison=self.comparison.value, slider=self.slider.value)

    def _begin(self) -> None:
        """Let browsers that come from now on begin at the chosen camera, or where all are in view."""
        camera, initial = self._cameras.by_name.get(self.camera.value), self._server.initial_camera
        if camera is None:
            return
        place, axes, up = camera_center(camera.R, camera.T), np.asarray(camera.R), self._cameras.up_at(camera.R)
        target, fov = self._cameras.target_of(place, axes), opening(camera)
        if self._all_drawn:
            place, axes, target = self._cameras.overview()
            up, fov = self._cameras.up, views.overview_fov(1.0)
        initial.position, initial.look_at, initial.up, initial.fov = place, target, tuple(up), fov
        self._beginning = place, axes

    def fit(self, client: "viser.ClientHandle") -> None:
        """Fit the opening angle of a browser that is where it began to its window, if that is new or has changed."""
        camera, pose = self._cameras.by_name.get(self.camera.value), views.pose_of(client.camera)
        if camera is None or pose is None or not self._cameras.stands_at(pose, *self._beginning):
            return
        window, before = (pose.width, pose.height), self._windows.get(client.client_id)
        self._windows[client.client_id] = window
        if window == before:
            return
        aspect = pose.width / pose.height
        if self._all_drawn:
            client.camera.fov = views.overview_fov(aspect)
        elif self.comparison.value == views.ALONE:
            client.camera.fov = narrowed(opening(camera), camera.image_width / camera.image_height, aspect)
        else:
            client.camera.fov = views.fov_of_canvas(camera, aspect)

    def left(self, client: int) -> None:
        """A browser has gone."""
        self.frusta.left(client)
        self._windows.pop(client, None)

    def _compare(self, client: "viser.ClientHandle | None") -> None:
        self.slider.visible = self.comparison.value == views.SLIDER
        if self.comparison.value != views.ALONE:
            self.go(client)

    def go(self, client: "viser.ClientHandle | None") -> None:
        """Move a browser's camera to the chosen one."""
        camera = self._cameras.by_name.get(self.camera.value)
        if client is not None and camera is not None:
            width, height = views.window_of(client.camera)
            place, fov = camera_center(camera.R, camera.T), views.fov_of_canvas(camera, width / height)
            self._cameras.move(client, place, np.asarray(camera.R), fov)

    def _choose(self, event: Any, name: str) -> None:
        self.camera.value = name
        self.go(event.client)
