"""The model that --keep_best saves: of all that were scored, the one that shows views best that do not train.

Early stopping by a validation set (Prechelt 1998, Early Stopping - But When?), with the training taken to its end: what
was best is known only then. Test views have no say.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import check_rows
from splatting.files.listing import some
from utils.system_utils import UserError


class BestModel:
    """The best model so far. cameras: the validation views; iteration: 0 before the first score; psnr: their mean, dB.

    Its rows lie in the memory of the host, as large as the PLY, and in each checkpoint.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self.cameras = sorted(cameras, key=lambda camera: camera.uid)
        self.iteration, self.psnr = 0, -math.inf
        self._degree, self._rows = 0, {}

    @property
    def _names(self) -> list[str]:
        return [camera.image_name for camera in self.cameras]

    def offer(self, gaussians: GaussianModel, iteration: int, psnr: float) -> None:
        """Keep a copy of a model of an iteration, if it is better than the best so far."""
        if psnr > self.psnr:
            self.iteration, self.psnr, self._degree = iteration, psnr, gaussians.active_sh_degree
            self._rows = {name: values.to("cpu", copy=True) for name, values in gaussians.drawn_rows().items()}

    def model(self, gaussians: GaussianModel, iteration: int) -> GaussianModel:
        """The best model, where that of the iteration is another one; it has no optimiser."""
        if self.iteration in (0, iteration):
            return gaussians
        best = copy.copy(gaussians)
        best.active_sh_degree, best.optimizer = self._degree, None
        best.set_rows(self._rows)
        return best

    def line(self, at_end: float | None) -> str:
        """What training says of it. at_end: the score of the last model."""
        who = f"{len(self.cameras)} validation photos ({some(self._names)})"
        if not self.iteration or at_end is None:
            return f"--keep_best saved the last model: {who} have no finite PSNR"
        than = f", {self.psnr - at_end:.2f} dB better than the last one" if self.psnr > at_end else ", the last one"
        return f"--keep_best saved the model of iteration {self.iteration}{than}, by {who}: {self.psnr:.2f} dB"

    def facts(self) -> dict[str, Any]:
        """What model.json keeps."""
        return {"iteration": self.iteration, "psnr": self.psnr if self.iteration else None, "views": self._names}

    def captured(self) -> dict[str, Any]:
        """State that a resumed training needs."""
        return {**self.facts(), "degree": self._degree, "rows": self._rows}

    def restore(self, state: dict[str, Any] | None, gaussians: GaussianModel) -> None:
        """Take the state of `captured()`. UserError for one that does not fit."""
        if not isinstance(state, dict) or state.get("views") != self._names:
            raise UserError(
                "the checkpoint was trained on the photos that --keep_best holds out; leave --keep_best out, or start "
                "a new training"
            )
        found, psnr, degree = (state.get(name) for name in ("iteration", "psnr", "degree"))
        try:
            if not found or psnr == math.inf:  # as version 0.1 kept it
                return
            self.iteration, self.psnr, self._degree = int(found), float(psnr), int(degree)
            self._rows = {name: state["rows"][name].cpu() for name in gaussians.rows()}
            check_rows(self._rows, gaussians._attributes, gaussians.max_sh_degree)
            if len({*map(len, self._rows.values())}) > 1 or not 0 <= self._degree <= gaussians.max_sh_degree:
                raise ValueError("its rows or its SH degree do not fit")
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
            raise UserError(f"the checkpoint's best model is damaged ({error}); give another checkpoint") from error
