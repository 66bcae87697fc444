"""The fused step: no gradient of a parameter is written, because the rasterizer's backward steps the Gaussians."""

import torch
from torch import Tensor

from gaussian_renderer.view_step import Drawn, draw, step
from scene.fused_adam import FusedAdam
from scene.gaussians.exposure import apply_exposure
from scene.lazy_rows import LazyRows
from training.density import AdaptiveDensityControl
from training.objective import Losses, Objective
from training.observer import Announcer
from training.run import Run
from training.step import Step
from training.steps.plain import PlainStep


class FusedStep:
    """Takes steps in which nothing but the optimiser uses the gradients, with the bytes of `PlainStep`.

    Autograd differentiates the loss by the image only, so any loss of image and depth will do, and exposures.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.plain = PlainStep(run)
        self._adam = FusedAdam(run.gaussians)
        self.lazy = LazyRows(run.gaussians)
        self._further_terms = False

    @staticmethod
    def suits(run: Run) -> bool:
        """Whether the run's objective and density control are ours, which use no gradient of a parameter."""
        return type(run.objective) is Objective and type(run.density) is AdaptiveDensityControl

    def takes(self, step: Step) -> bool:
        """Whether this step can be fused. The last one, and one that changes the Gaussians' rows, use the gradients."""
        run, pipe = self._run, self._run.pipe
        in_python = pipe.compute_cov3D_python or pipe.convert_SHs_python or pipe.debug
        able = not (step.changes or step.last or in_python or self._further_terms)
        return able and FusedAdam.takes(run.gaussians)

    def take(self, step: Step, tell: Announcer) -> None:
        """Take a step; the observers are told once the loss is known."""
        if self.takes(step):
            self.let_rows_wait(step)
            drawn, losses, gradients = self.measure(step)
            if step.due:
                self.lazy.observe(drawn.tile_counts)
            if not self.finds_further_terms():
                tell.measured(step, losses)
                return self.advance(step, drawn, gradients)
        self.settle()
        self.plain.take(step, tell)

    def let_rows_wait(self, step: Step) -> None:
        """Decide whether rows may lack steps after this one. They must not where somebody reads the model."""
        if step.due or self.lazy.must_settle:
            self.settle()
        else:
            self.lazy.begin()

    def settle(self) -> None:
        """Let all rows take the steps that they lack; no step is ever pending."""
        self.lazy.settle()

    def give_up(self) -> int:
        """Settle, after an error. No step has to be taken back: 0."""
        self.settle()
        return 0

    def measure(self, step: Step) -> tuple[Drawn, Losses, tuple[Tensor, Tensor | None]]:
        """Render: what was drawn, the losses, and their gradients of image and depth."""
        run = self._run
        wanted = run.pipe, step.background, step.depth_weight > 0, self._waiting
        drawn = draw(step.camera, run.gaussians, *wanted)
        with torch.enable_grad():
            image, depth = drawn.image.requires_grad_(), drawn.depth
            if depth is not None:
                depth.requires_grad_()
            rendered = image
            if run.dataset.train_test_exp and (name := step.camera.exposure_name or step.camera.image_name) is not None:
                rendered = apply_exposure(image, run.gaussians.get_exposure_from_name(name))
            losses = run.objective({"render": rendered, "depth": depth}, step)
            losses.total.backward()
        # Observers keep losses for a while, which must not keep the image and its gradient.
        losses = losses._replace(
            **{name: value.detach() for name, value in losses._asdict().items() if value is not None}
        )
        return drawn, losses, (image.grad, None if depth is None else depth.grad)

    @property
    def _waiting(self) -> LazyRows | None:
        return self.lazy if self.lazy.active else None

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
        step(drawn, self._adam, *gradients, run.density.observes(at.iteration), self._waiting)
        run.gaussians.exposures.step()
        run.density.after_step(at)
