"""The tab that says what is drawn, and how."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from viewing.in_turn import in_turn
from viewing.settings import MODES, Settings, Vector

if TYPE_CHECKING:
    import viser

_LARGEST = 2.0  # scaling modifier
_OUTLIERS = 0.02  # quantile of the positions at which the crop box begins


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
        self.scaling = gui.add_slider("Scaling modifier", 0.01, _LARGEST, 0.01, 1.0)
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
            handle.on_update(in_turn(lambda _: (self._show_box(), changed())))

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
            scaling=min(max(scaling, 0.0), _LARGEST),
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
