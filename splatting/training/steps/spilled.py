"""The step of a model of which a part lies in the host's memory: the plain one, of the Gaussians that the view sees."""

import torch
from torch import Tensor

from gaussian_renderer import visible_rows
from scene.gaussian_model import GaussianModel
from splatting.training.objective import Losses
from splatting.training.step import Step
from splatting.training.steps.plain import PlainStep


class SpilledStep(PlainStep):
    """Takes the steps of a `SpilledGaussians` with the bytes of `PlainStep`."""

    def render(self, step: Step, gaussians: GaussianModel) -> dict[str, Tensor]:
        run = self._run
        seen = gaussians.fetch(visible_rows(step.camera, gaussians, run.pipe))
        package = super().render(step, seen)
        if not (step.last or step.changes):  # after a change of rows, copies would be in vain
            # As it would see them now; what the step moves into view is copied late.
            gaussians.fetch_ahead(visible_rows(run.views[step.iteration + 1], gaussians, run.pipe))
        return package

    def follow(self, losses: Losses, package: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute the gradients of all rows. Returns the package with a row for each of them."""
        run = self._run
        gaussians = run.gaussians
        losses.total.backward()
        rows = gaussians.take_gradients()
        count = len(gaussians)
        points = package["viewspace_points"]
        radii = package["radii"].new_zeros(count).index_copy_(0, rows, package["radii"])
        every = torch.zeros(count, 3, dtype=points.dtype, device=points.device)
        every.grad = torch.zeros_like(every).index_copy_(0, rows, points.grad)
        return package | {"viewspace_points": every, "radii": radii}
