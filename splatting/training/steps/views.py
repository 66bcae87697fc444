"""The step of a batch of views, one on each rank (--parallel views)."""

from typing import Any

import torch
from diff_gaussian_rasterization.gaussians import Gaussians
from torch import Tensor

from gaussian_renderer import model_inputs, rasterizer_settings
from scene.gaussians.exposure import apply_exposure
from splatting.distributed.ranks import ranks
from splatting.distributed.rendering.views import rasterize_views
from splatting.training.objective import Losses
from splatting.training.step import Step
from splatting.training.steps.plain import PlainStep


class ViewsStep(PlainStep):
    """Follows the sum of the gradients of a batch's views, and counts each view in the statistics.

    Adam's steps do not depend on a gradient's scale, so the sum does what the mean would. The losses that the observers
    are told are means over the batch.
    """

    def backward(self, step: Step) -> tuple[dict[str, Any], Losses]:
        run, here = self._run, ranks()
        package = self._render(step)
        losses = run.objective(package, step)
        losses.total.backward()
        if run.dataset.train_test_exp:
            run.gaussians.exposures.add_gradients(here)
        if any(run.density.penalty):
            run.gaussians.penalise(run.density.penalty.times(here.size))
        return package, _mean(losses)

    def _render(self, step: Step) -> dict[str, Tensor | None]:
        run = self._run
        gaussians, pipe = run.gaussians, run.pipe
        options = run.render_options(step)
        geometry, raw, colors = model_inputs(step.camera, gaussians, pipe)
        settings = [
            rasterizer_settings(camera, gaussians, pipe, background) for camera, background in run.batch(step.iteration)
        ]
        screen = gaussians.get_xyz.new_zeros(len(settings), len(gaussians), 3).requires_grad_()
        drawn = rasterize_views(
            ranks(),
            Gaussians(gaussians.get_xyz, **geometry, **colors),
            screen,
            settings,
            raw=raw,
            want_inverse_depth=options["want_depth"],
            want_absolute_gradient=options["want_absolute_gradient"],
        )
        image = drawn.color
        if run.dataset.train_test_exp and (name := step.camera.exposure_name or step.camera.image_name) is not None:
            image = apply_exposure(image, gaussians.get_exposure_from_name(name))
        return {"render": image, "depth": drawn.inverse_depth, "viewspace_points": screen, "radii": drawn.radii}


def _mean(losses: Losses) -> Losses:
    """Means over the ranks; the mask stays that of the rank's own view."""
    own = torch.stack([losses.total.detach(), losses.l1.detach()])
    total, l1 = ranks().table(own).mean(0)
    return losses._replace(total=total, l1=l1, depth=None if losses.depth is None else losses.depth.detach())
