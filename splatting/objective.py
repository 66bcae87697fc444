"""The loss of a render: the photometric loss, and the terms that parts add to it."""

from typing import TYPE_CHECKING, Any, ClassVar

import torch
from fused_ssim import photometric_loss_by_bands
from torch import Tensor

from splatting.iteration import Iteration, Losses, Term
from utils.loss_utils import photometric_loss

if TYPE_CHECKING:
    from splatting.run import Run


class Objective:
    """`(1 - lambda_dssim) L1 + lambda_dssim (1 - SSIM)` (Kerbl et al. 2023, Eq. 7), and the terms of parts.

    Strategies decide whether renders are clamped to [0, 1] before the comparison (Strategy.clamps).

    fusable: true if the loss needs gradients of image and depth alone, so that a fused step can take it.
    """

    fusable: ClassVar[bool] = True

    def __init__(self, run: "Run") -> None:
        """Take the options and the strategy of a run (splatting/run.py)."""
        self._run = run

    def takes_bands(self, at: Iteration) -> bool:
        """Tell whether the loss of a step needs no more of the image than each rank's band and the rows around it."""
        return not self.terms(at) and at.camera.counts_all_pixels and at.camera.columns is None

    def terms(self, at: Iteration) -> dict[str, Term]:
        """Return the terms that a step adds to the photometric loss, weights included, by name."""
        return at.terms

    def __call__(self, package: dict[str, Any], at: Iteration) -> Losses:
        """Return the losses of a render. Gradients are valid only inside a `band`, if there is one.

        package: the result of `render`, with `depth` where the step needs it.
        """
        camera = at.camera
        target, mask = camera.ground_truth(at.background)
        image, weight, clamp = package["render"], self._run.opt.lambda_dssim, self._run.strategy.clamps
        if (band := package.get("band")) is not None:
            total, l1 = photometric_loss_by_bands(image, target, weight, *band, clamp)
            return Losses(total, l1, terms={}, mask=None)
        if (pixels := self._run.pixel_filter) is not None:
            mask = pixels.mask(at, image.detach(), target, mask)
        total, l1 = photometric_loss(image, target, weight, mask, camera.columns, clamp)
        further = {name: term(package, mask) for name, term in self.terms(at).items()}
        return Losses(sum(further.values(), start=total), l1, further, mask)


NEWEST = 0.4  # weight of the newest loss in the running mean, as in the reference


class LossWatch:
    """Collects one loss per iteration without waiting for the device; `read` waits once for all of them.

    mean: exponential running mean of all losses that were read, from the given start.
    """

    def __init__(self, mean: float = 0.0) -> None:
        self.mean = mean
        self._losses: dict[int, Tensor] = {}

    def add(self, iteration: int, loss: Tensor) -> None:
        """Note the scalar loss of an iteration."""
        self._losses[iteration] = loss.detach()

    def read(self) -> dict[int, float]:
        """Return the losses since the last read, by iteration."""
        if not self._losses:
            return {}
        values = torch.stack(list(self._losses.values())).tolist()
        read = dict(zip(self._losses, values, strict=True))
        self._losses.clear()
        for value in values:
            self.mean = NEWEST * value + (1 - NEWEST) * self.mean
        return read
