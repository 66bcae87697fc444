"""The step of a model of which a part lies in the host's memory: the plain one, of the Gaussians that the view sees."""

import torch
from torch import Tensor

from gaussian_renderer import visible_rows
from scene.gaussian_model import GaussianModel
from training.objective import Losses
from training.step import Step
from training.steps.plain import PlainStep


class SpilledStep(PlainStep):
    """Takes the steps of a `SpilledGaussians` with the bytes of `PlainStep`."""

    def render(self, step: Step, gaussians: GaussianModel) -> dict[str, Tensor]:
        seen = gaussians.fetch(visible_rows(step.camera, gaussians, self._run.pipe))
        return super().render(step, seen)

    def follow(self, losses: Losses, package: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute the gradients of all rows. Returns the package with a row for each of them."""
        losses.total.backward()
        gaussians = self._run.gaussians
        rows = gaussians.take_gradients()
        count = len(gaussians)
        points = package["viewspace_points"]
        radii = package["radii"].new_zeros(count).index_copy_(0, rows, package["radii"])
        every = torch.zeros(count, 3, dtype=points.dtype, device=points.device)
        every.grad = torch.zeros_like(every).index_copy_(0, rows, points.grad)
        return package | {"viewspace_points": every, "radii": radii}
