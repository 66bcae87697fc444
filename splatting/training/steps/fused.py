"""The fused step: no gradient of a parameter is written, because the rasterizer's backward steps the Gaussians."""

import torch
from torch import Tensor

from gaussian_renderer.view_step import Drawn, draw, step
from scene.fused_adam import FusedAdam
from scene.gaussians.exposure import apply_exposure
from splatting.distributed.ranks import ranks
from splatting.distributed.rendering.bands import KnownBands
from splatting.training.objective import Losses, Objective
from splatting.training.observer import Announcer
from splatting.training.run import Run
from splatting.training.step import Step
from splatting.training.steps.plain import PlainStep


class FusedStep:
    """Takes steps in which nothing but the optimiser uses the gradients, with the bytes of `PlainStep`.

    Autograd differentiates the loss by the image only, so any loss of image and depth will do, and exposures.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.plain = PlainStep(run)
        self._adam = FusedAdam(run.gaussians, run.density.penalty)
        self._bands = KnownBands()
        self._further_terms = False

    @staticmethod
    def suits(run: Run) -> bool:
        """Whether the run's objective is ours, and its density control wants no gradient of a parameter."""
        return type(run.objective) is Objective and vars(type(run.density)).get("fusable", False)

    def takes(self, step: Step) -> bool:
        """Whether this step can be fused."""
        return self.is_usual(step) and FusedAdam.takes(self._run.gaussians)

    def is_usual(self, step: Step) -> bool:
        """Whether it can be as far as the model does not matter.

        The last step, and one that changes the Gaussians' rows, use the gradients.
        """
        pipe = self._run.pipe
        in_python = pipe.compute_cov3D_python or pipe.convert_SHs_python or pipe.debug
        return not (step.changes or step.last or in_python or self._further_terms)

    def take(self, step: Step, tell: Announcer) -> None:
        """Take a step; the observers are told once the loss is known."""
        if self.takes(step):
            drawn, losses, gradients = self.measure(step)
            if not self.finds_further_terms():
                tell.measured(step, losses)
                return None if step.last else self.advance(step, drawn, gradients)
        self.plain.take(step, tell)

    def make_ready(self, step: Step) -> None:
        """Nothing is ever pending."""

    def settle(self) -> None:
        """Nothing is ever pending."""

    def give_up(self) -> int:
        """Nothing is ever pending, so no step has to be taken back: 0."""
        return 0

    def measure(self, step: Step) -> tuple[Drawn, Losses, tuple[Tensor, Tensor | None]]:
        """Render: what was drawn, the losses, and their gradients of image and depth."""
        run = self._run
        exposed = run.dataset.train_test_exp
        by_bands = ranks().several and not exposed and run.objective.takes_bands(step)
        want_depth = step.depth_weight > 0
        drawn = draw(step.camera, run.gaussians, run.pipe, step.background, want_depth, by_bands, self._bands)
        with torch.enable_grad():
            image, depth = drawn.image.requires_grad_(), drawn.depth
            if depth is not None:
                depth.requires_grad_()
            rendered = image
            if exposed and (name := step.camera.exposure_name or step.camera.image_name) is not None:
                rendered = apply_exposure(image, run.gaussians.get_exposure_from_name(name))
            losses = run.objective({"render": rendered, "depth": depth, "band": drawn.band}, step)
            losses.total.backward()
        # Observers keep losses for a while, which must not keep the image and its gradient.
        losses = losses._replace(
            **{name: value.detach() for name, value in losses._asdict().items() if value is not None}
        )
        return drawn, losses, (image.grad, None if depth is None else depth.grad)

    def finds_further_terms(self) -> bool:
        """Whether the loss of the last `measure` depends on a parameter by another way than the image.

        Somebody has added a term to it. Its gradients are dropped, and from now on no step can be fused.
        """
        params = [self._run.gaussians.raw(name) for name in self._run.gaussians._attributes]
        self._further_terms = any([param.grad is not None for param in params])
        if self._further_terms:
            for param in params:
                param.grad = None
        return self._further_terms

    def advance(self, at: Step, drawn: Drawn, gradients: tuple[Tensor, Tensor | None]) -> None:
        """Take the step of the Gaussians, and that of the exposures."""
        run = self._run
        step(drawn, self._adam, *gradients, run.density.observes(at.iteration), run.density.absolute_gradients)
        run.gaussians.exposures.step()
        run.density.after_step(at)
