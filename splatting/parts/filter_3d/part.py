"""The 3D smoothing filter of Yu et al. 2024 (--filter_3d): no Gaussian is finer than the training photos can show."""

from typing import TYPE_CHECKING, Any

from splatting.option import Option
from splatting.part import Options, Part, fill

if TYPE_CHECKING:
    from splatting.training.iteration import Iteration

INTERVAL = 500  # iterations, at most, between updates: positions hardly move in as many


class Filter3d(Part):
    """Keeps the width of each Gaussian's filter, and lets the model be drawn and saved behind it."""

    name = "filter_3d"
    tools = ("drawn",)
    # fmt: off
    options = Options(optimisation=(
        Option("filter_3d", False, origin="ours", topic="quality and speed",
            help="limit how small Gaussians get by the resolution of the training photos (Mip-Splatting), so that "
                 "views from other distances look right. The PLY contains the filter; best with --antialiasing"),
    ))
    # fmt: on

    def begin(self, run: Any, state: Any) -> None:
        self._run, self._state = run, state

    def ready(self, run: Any) -> None:
        from splatting.parts.filter_3d.smoothing import Smoothing, check_widths

        model = run.gaussians
        fill(model, "drawn", Smoothing(model), self)
        self._update()
        if self._state is not None:
            check_widths(self._state, model.gaussian_count)
            model.columns[self.name] = model.shards.own(self._state).to(model.columns[self.name])
        self._state = None  # it is as large as the model

    def _update(self) -> None:
        from splatting.parts.filter_3d.smoothing import filter_widths

        model, views = self._run.gaussians, self._run.scene.getTrainCameras()
        model.columns[self.name] = filter_widths(model.get_xyz.detach(), views, model.enlargement)

    def changes(self, iteration: int) -> bool:
        return iteration % INTERVAL == 0

    def after_change(self, at: "Iteration") -> None:
        self._update()

    def state(self) -> Any:
        model = self._run.gaussians
        widths = model.columns[self.name]
        whole = len(widths) == len(model)  # not where memory ran out on the way
        return model.shards.whole(widths) if whole else None
