"""The tab View, whose controls choose the picture, and parts that all tabs use."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from applications.viewer import views
from applications.viewer.views import Settings, Vector
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

_MOST_SCALING = 2.0  # scaling modifier
_OUTLIERS = 0.02  # quantile of the positions at which the crop box begins
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


Refuse = Callable[["viser.ClientHandle", UserError], None]


def serialize(call: Callable[[Any], object], refuse: Refuse | None = None) -> Callable[[Any], Any]:
    """Return a handler for a control that calls `call`, so that no two calls of handlers overlap.

    viser runs coroutines one after the other, but plain functions in many threads at once; so the handler is a
    coroutine.

    call: called with the event of the control.
    refuse: called with the browser and a UserError of `call`; None: the error is raised.
    """

    async def called(event: Any) -> None:
        try:
            call(event)
        except UserError as error:
            if refuse is None:
                raise
            refuse(event.client, error)

    return called


class FileName:
    """A field with the name of a file. Whatever a browser sends, the file lies in the folder and has the ending."""

    def __init__(self, server: "viser.ViserServer", folder: Path, first: str, ending: str) -> None:
        self.folder, self._first, self._ending = folder, first, ending
        self._suggested = self._find_free_name()
        self.field = server.gui.add_text("Name", self._suggested, hint="letters, digits, - and _")

    def _find_free_name(self) -> str:
        """Return the first name with a number that no file of the folder has."""
        number = 1
        while (self.folder / f"{self._first}{number}{self._ending}").exists():
            number += 1
        return f"{self._first}{number}"

    def suggest(self) -> None:
        """Put the next free name in the place of the one that was suggested before, but not of one that was typed."""
        if self.field.value == self._suggested:
            self.field.value = self._suggested = self._find_free_name()

    def path(self) -> Path:
        """The file. UserError for a name that is none."""
        if not _NAME.fullmatch(self.field.value):
            raise UserError("a name has 1 to 64 letters, digits, - and _; choose another one")
        return self.folder / f"{self.field.value}{self._ending}"

    def replaced(self) -> str:
        """Return a remark for a file that is to be written but exists already; "" if it does not exist."""
        return " (replaced)" if self.path().exists() else ""

    def names(self) -> tuple[str, ...]:
        """Names of the files that are there."""
        return tuple(sorted(file.stem for file in self.folder.glob(f"*{self._ending}") if _NAME.fullmatch(file.stem)))


class ViewTab:
    """Controls for mode, scaling modifier, SH degree, background, cleaning and crop box.

    changed: called when one of them moves. export: called when the crop box is to be written. folder: for its files.
    positions: (N, 3) of the Gaussians, for a first crop box. cleaned: whether it is known what cleaning leaves.
    photos: whether there are any, to show errors. covered: whether it is known what training views have shown.
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
        covered: bool,
    ) -> None:
        """Put the controls into the current tab of the server.

        changed: called when the picture changes.
        export: called to write the Gaussians of the crop box.
        folder: of the model.
        positions: of the Gaussians, (N, 3).
        background: RGB in [0, 1].
        cleaned, photos, covered: true if the model has a cleaned part, photos, training views that cover it.
        """
        gui, self._scene = server.gui, server.scene
        self.mode = gui.add_dropdown("Show", views.MODES if photos else views.MODES[: views.MODES.index(views.ERROR)])
        hint = "what no training photo shows from about this direction; there the model guesses"
        self.darken = gui.add_checkbox("Darken guesses", covered, hint=hint, visible=covered)
        self.background = gui.add_rgb("Background", tuple(round(255 * x) for x in background))
        self.cleaning = gui.add_dropdown(
            "Cleaning", views.CLEANINGS, visible=cleaned, hint="what export.py --clean does"
        )
        self.crop = gui.add_checkbox("Crop box", False, hint="Gaussians outside are not drawn; the model stays whole")
        low, high = find_first_box(positions)
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
        drawn = self.mode, self.darken, self.scaling, self.degree, self.background, self.cleaning
        shown = *drawn, self.crop, *self.box
        self._first = [(handle, handle.value) for handle in shown]
        for handle in drawn:
            handle.on_update(lambda _: (self._update_reset(), changed()))
        for handle in (self.crop, *self.box):
            handle.on_update(serialize(lambda _: (self._show_box(), self._update_reset(), changed())))
        written.on_click(lambda _: export())
        self.reset.on_click(serialize(lambda _: self._reset()))

    def _update_reset(self) -> None:
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
        """Read the settings from the controls; a number out of range becomes the nearest one in it."""
        box = self.corners() if self.crop.value else None
        return Settings(
            mode=self.mode.value,
            darken=self.darken.value,
            scaling=min(max(self.scaling.value, 0.0), _MOST_SCALING),
            sh_degree=max(int(self.degree.value), 0),
            background=tuple(min(max(x / 255, 0.0), 1.0) for x in self.background.value),
            crop=box,
            cleaning=self.cleaning.value,
        )


def find_first_box(positions: Tensor) -> tuple[Vector, Vector]:
    """A box around most positions (N, 3), rounded to thousandths of its size: its lowest and highest corner."""
    some = positions.detach()[:: max(1, len(positions) // 100_000)].double().cpu()
    some = some[some.isfinite().all(1)]
    if not len(some):
        return (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    low, high = (torch.quantile(some, q, dim=0) for q in (_OUTLIERS, 1 - _OUTLIERS))
    digits = 3 - math.floor(math.log10(max(float((high - low).max()), 1e-9)))
    return tuple(tuple(round(x, digits) for x in corner.tolist()) for corner in (low, high))
