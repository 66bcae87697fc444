"""The views of an iteration in which each rank shows one of its own (--parallel views)."""

from typing import Any

import torch
from torch import Tensor

from gaussian_renderer import exposed, model_inputs, rasterizer_settings
from scene.fused_adam import CAMERA_NUMBERS
from splatting.distributed.rendering.views import rasterize_views


class ViewOfEach:
    """Renders the rank's own view with the Gaussians of all ranks; `OneView` of training/steps/plain.py.

    A step follows the sum of the gradients of the batch's views, and counts each view in the statistics. Adam's steps
    do not depend on a gradient's scale, so the sum does what the mean would. run: of the training.
    """

    def __init__(self, run: Any) -> None:
        self._run = run

    def render(self, at: Any) -> dict[str, Tensor | None]:
        run = self._run
        gaussians, pipe = run.gaussians, run.pipe
        options = run.render_options(at)
        inputs, raw = model_inputs(at.camera, gaussians, pipe)
        batch = run.batch(at.iteration)
        for camera, _ in batch if run.poses else ():
            run.poses.place(camera)
        settings = [rasterizer_settings(camera, gaussians, pipe, background) for camera, background in batch]
        screen = gaussians.get_xyz.new_zeros(len(settings), len(gaussians), 3).requires_grad_()
        self._cameras = [camera for camera, _ in batch]
        self._numbers = screen.new_zeros(len(settings), CAMERA_NUMBERS, dtype=torch.float64)
        drawn = rasterize_views(
            run.group,
            inputs,
            screen,
            settings,
            self._numbers.requires_grad_(bool(run.poses)),
            raw=raw,
            want_inverse_depth=options["want_depth"],
            want_absolute_gradient=options["want_absolute_gradient"],
        )
        image = drawn.color
        if options["use_trained_exp"]:
            image = exposed(image, at.camera, gaussians)
        return {"render": image, "depth": drawn.inverse_depth, "viewspace_points": screen, "radii": drawn.radii}

    def collect(self, at: Any, package: dict[str, Tensor | None], losses: Any) -> tuple[dict[str, Tensor | None], Any]:
        """Means of the losses over the ranks; the mask stays that of the rank's own view."""
        run = self._run
        if run.poses and not at.last:
            run.step_poses(at, self._cameras, self._numbers.grad)
        if run.exposes:
            for group in run.gaussians.exposures.optimizer.param_groups:
                (values,) = group["params"]
                own = torch.zeros_like(values) if values.grad is None else values.grad
                values.grad = run.group.table(own).sum(0)
        own = torch.stack([losses.total.detach(), losses.l1.detach()])
        total, l1 = run.group.table(own).mean(0)
        depth = None if losses.depth is None else losses.depth.detach()
        return package, losses._replace(total=total, l1=l1, depth=depth)
