"""The plain step: autograd, with every gradient of every parameter there for whoever wants it."""

from torch import Tensor

from gaussian_renderer import render
from scene.gaussian_model import GaussianModel
from splatting.training.objective import Losses
from splatting.training.observer import Announcer
from splatting.training.run import Run
from splatting.training.step import Step


class PlainStep:
    """Renders a view, compares it with its photo, follows the gradient, controls density, steps the optimisers."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def take(self, step: Step, tell: Announcer) -> None:
        """Take a step; the observers are told once the gradients are there."""
        package, losses = self.backward(step)
        tell.measured(step, losses)
        self.advance(step, package)

    def make_ready(self, step: Step) -> None:
        """Nothing is ever pending."""

    def settle(self) -> None:
        """Nothing is ever pending."""

    def give_up(self) -> int:
        """Nothing is ever pending, so no step has to be taken back: 0."""
        return 0

    def backward(self, step: Step) -> tuple[dict[str, Tensor], Losses]:
        """Render and differentiate: the result of `render`, and the losses."""
        run = self._run
        package = self.render(step, run.gaussians)
        losses = run.objective(package, step)
        package = self.follow(losses, package)
        if any(run.density.penalty):
            run.gaussians.penalise(run.density.penalty)
        return package, losses

    def render(self, step: Step, gaussians: GaussianModel) -> dict[str, Tensor]:
        """The result of `render`, with what the loss needs."""
        run = self._run
        return render(step.camera, gaussians, run.pipe, step.background, **run.render_options(step))

    def follow(self, losses: Losses, package: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute the gradients. Returns the result of `render`."""
        losses.total.backward()
        return package

    def advance(self, step: Step, package: dict[str, Tensor]) -> None:
        """Let density control and the optimisers use the gradients."""
        run = self._run
        run.density.after_backward(step, package)
        if not step.last:  # as in the reference, the last iteration takes no step
            run.gaussians.step(package["radii"])
            run.density.after_step(step)
