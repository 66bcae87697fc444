"""The view of a plain step whose pose is trained, too."""

import torch

from gaussian_renderer import render
from scene.poses import moved
from splatting.training.iteration import Iteration
from splatting.training.objective import Losses
from splatting.training.steps.plain import OneView, Package


class RefinedView(OneView):
    """Renders the view at its current pose, and gives the pose its gradient; the pose steps after the Gaussians."""

    def render(self, at: Iteration) -> Package:
        run = self._run
        run.poses.settle(at.camera)
        self._uid, self._twist = at.camera.uid, torch.zeros(6, dtype=torch.float64, requires_grad=True)
        camera = moved(at.camera, self._twist)
        return render(camera, run.gaussians, run.pipe, at.background, **run.render_options(at))

    def collect(self, package: Package, losses: Losses) -> tuple[Package, Losses]:
        self._run.poses.take_gradient(self._uid, self._twist.grad)
        return package, losses
