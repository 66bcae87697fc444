"""The 3D smoothing filter of Yu et al. 2024 (Mip-Splatting), section 4.1: no Gaussian is finer than the photos show.

A Gaussian's covariance is convolved with an isotropic one, whose variance is VARIANCE over the square of the highest
rate (pixels by unit of length) at which a training view samples it (equations 6 to 9).
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from splatting.option import Option
from splatting.part import Options, Part, fill
from utils.system_utils import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from scene.gaussians.attributes import Rows
    from scene.gaussians.parameters import GaussianParameters
    from splatting.training.iteration import Iteration

INTERVAL = 500  # iterations, at most, between updates: positions hardly move in as many
# In squared pixels. The paper's 0.2 goes with renders that add 0.1. Ours, and those of all viewers, add 0.3 already.
VARIANCE = 0.05
NAME = "filter_3d"  # of the part, and of its column


class Filter3d(Part):
    """Keeps the width of each Gaussian's filter, and lets the model be drawn and saved behind it."""

    name = NAME
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
        model = run.gaussians
        fill(model, "drawn", Smoothing(model), self)
        self._update()
        if self._state is not None:
            check_widths(self._state, model.gaussian_count)
            model.columns[self.name] = model.shards.own(self._state).to(model.columns[self.name])
        self._state = None  # it is as large as the model

    def _update(self) -> None:
        model, views = self._run.gaussians, self._run.scene.getTrainCameras()
        model.columns[self.name] = filter_widths(model.get_xyz.detach(), views, model.enlargement)

    def changes(self, iteration: int) -> bool:
        return iteration % INTERVAL == 0

    def after_step(self, at: "Iteration") -> None:
        if at.changes:
            self._update()

    def state(self) -> Any:
        model = self._run.gaussians
        widths = model.columns[self.name]
        whole = len(widths) == len(model)  # not where memory ran out on the way
        return model.shards.whole(widths) if whole else None


class Smoothing:
    """Raw opacities and scales of a model behind its filter: the slot `model.drawn`."""

    def __init__(self, model: "GaussianParameters") -> None:
        """The widths (N, 1) of the filter are the model's column of this name."""
        from scene.gaussians.filtered import chain_of, filtered

        self._model, self._filtered, self.chain = model, filtered, chain_of

    def __call__(self, logits: "Tensor", log_scales: "Tensor") -> "tuple[Tensor, Tensor]":
        return self._filtered(logits, log_scales, self._model.columns[NAME])


def filter_widths(points: "Tensor", views: Sequence[Any], enlargement: float = 1.0) -> "Tensor":
    """Standard deviations (N, 1) of the filter at points (N, 3), in units of length; 0 where no view shows a point.

    enlargement: of the model where it is drawn.
    """
    import torch

    from scene.sampling_rate import sampling_rate

    rates = torch.zeros_like(points[:, 0])
    for view in views:
        rates = torch.maximum(rates, sampling_rate(points, view, enlargement))
    return torch.where(rates > 0, math.sqrt(VARIANCE) / rates, 0.0)[:, None]


def check_widths(widths: Any, count: int) -> None:
    """UserError for what a checkpoint has as its filter, if it does not fit so many Gaussians."""
    import torch

    if not torch.is_tensor(widths) or widths.shape != (count, 1) or widths.dtype != torch.float32:
        raise UserError("the 3D filter of the checkpoint does not fit its Gaussians; give another one")


def drawn(rows: "Rows", states: dict[str, Any]) -> "Rows":
    """Rows of a checkpoint as its PLY would have them. states: of parts, by name."""
    from scene.gaussians.filtered import filtered

    if (widths := states.get(NAME)) is None:
        return rows
    check_widths(widths, len(rows["xyz"]))
    opacity, scaling = filtered(rows["opacity"], rows["scaling"], widths.to(rows["xyz"].device))
    return rows | {"opacity": opacity, "scaling": scaling}
