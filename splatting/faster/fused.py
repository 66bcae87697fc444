"""The fused step: no gradient of a parameter is written, because the rasterizer's backward steps the Gaussians."""

import torch
from torch import Tensor

from gaussian_renderer import CachedBands, Drawn, apply_trained_exposure, draw, to_world_units
from scene.fused_adam import CAMERA_NUMBERS, FusedAdam
from splatting.faster.faster import FasterSteps, Tell
from splatting.iteration import Iteration, Losses
from splatting.run import Run

Gradients = tuple[Tensor, Tensor | None]  # of image and depth
Measured = tuple[Drawn, Losses, Gradients]


class FusedStep(FasterSteps):
    """Fuses backward and optimiser, byte-equal to the plain step, which is taken if anything else reads gradients.

    Autograd differentiates the loss by the image alone. So the loss may be any function of image and depth, and of
    exposures.
    """

    def __init__(self, run: Run) -> None:
        """Prepare the fused optimiser and, where cameras are trained, the gradient of a camera's numbers."""
        self._run = run
        pose = torch.zeros(CAMERA_NUMBERS, dtype=torch.float64, device=run.device) if run.camera_steps else None
        self.camera_gradient = pose  # of the last step
        self._adam = FusedAdam(run.gaussians, run.strategy.penalty)
        self.absolute_gradients = run.strategy.takes_absolute(run.opt)
        self._bands = CachedBands()
        self._is_known = False  # whether the model is one that the operator steps
        self._has_parameter_terms = False

    @staticmethod
    def suits(run: Run) -> bool:
        """Tell whether nobody else needs gradients, as objectives and strategies of others may, and some options do."""
        return run.is_standard and not (run.launch.plain_step or torch.is_anomaly_enabled())

    def take(self, at: Iteration, tell: Tell) -> bool:
        """Take the step, and tell observers its losses. Return False for a step that `plain_step` must take."""
        if not self._fuses(at):
            return False
        drawn, losses, gradients = self.measure(at)
        if self.drops_parameter_terms():
            return False
        tell.measured(at, losses)
        self.advance(at, drawn, gradients)
        del drawn, gradients  # what changes rows needs their memory
        if self.camera_gradient is not None and at.steps:
            self._run.step_camera(at, self.camera_gradient)
        self.follow(at)
        return True

    def _fuses(self, at: Iteration) -> bool:
        """Tell whether the step of this iteration can be fused."""
        if self._run.pipe.debug or self._has_parameter_terms:
            self._is_known = False
            return False
        if at.due or not self._is_known:
            if not self._knows_model():
                return False
            # Only where something is due may somebody replace the model's tensors, or wait for gradients.
            self._is_known = not at.due
        return True

    def _knows_model(self) -> bool:
        return FusedAdam.takes(self._run.gaussians)

    def measure(self, at: Iteration, now: Tensor | None = None) -> Measured:
        """Render a view. Return what was drawn, the losses, and the losses' gradients by image and depth.

        now: (NOW_WORDS,) int64 on the GPU, numbers of the step that a graph reads; None: the step is not captured.
        """
        run = self._run
        if run.camera_steps and now is None:
            run.camera_steps.place(at.camera)
        whole = at.changes or not at.steps  # all blocks wake, as in a plain step
        if whole and run.sleeping:
            run.sleeping.flush()
        applied, objective = run.gaussians.exposures.applied, run.objective
        by_bands = run.group.several and not applied and objective.takes_bands(at)
        wants = {"want_depth": at.wants_depth, "by_bands": by_bands, "bands": self._bands}
        wants |= {"sleeping": None if whole else run.sleeping, "now": now}
        drawn = draw(at.camera, run.gaussians, run.pipe, at.background, **wants)
        with torch.enable_grad():
            image, depth = drawn.image.requires_grad_(), drawn.depth
            if depth is not None:
                depth.requires_grad_()
            color = apply_trained_exposure(image, at.camera, run.gaussians) if applied else image
            package = {"render": color, "depth": to_world_units(depth, run.gaussians), "band": drawn.band}
            losses = objective(package, at)
            losses.total.backward()
        # Observers keep losses for a while, which must not keep the image and its gradient.
        return drawn, losses.detached(), (image.grad, None if depth is None else depth.grad)

    def drops_parameter_terms(self) -> bool:
        """Tell whether the loss of the last `measure` depends on a parameter otherwise than by the image.

        This is so if somebody has added a term to the loss. The gradients of that term are dropped, and from now on all
        steps are plain. Blocks of rows go on sleeping until a plain step finds that the term reaches them: to wake them
        here would lose the wake-up of all blocks (REST of scene/sleeping.py) if a step has halted.
        """
        gaussians = self._run.gaussians
        params = [gaussians.raw(name) for name in gaussians._attributes]
        self._has_parameter_terms = any([param.grad is not None for param in params])
        if self._has_parameter_terms:
            gaussians.drop_gradients()
        return self._has_parameter_terms

    def advance(self, at: Iteration, drawn: Drawn, gradients: Gradients) -> None:
        """Take the step of the Gaussians, unless they take none, and add the view to the statistics."""
        gaussians, strategy = self._run.gaussians, self._run.strategy
        adam, steps, observes = self._adam, at.steps, at.density.observe
        if not at.steps or at.changes:
            left_out = strategy.skips_step(at) if at.steps else gaussians._attributes
            steps = len(left_out) < len(gaussians._attributes)
            adam = FusedAdam(gaussians, strategy.penalty, left_out)
        if steps or observes or self.camera_gradient is not None:
            drawn.step(adam, *gradients, observes, self.absolute_gradients, camera=self.camera_gradient)

    def follow(self, at: Iteration) -> None:
        """Let the strategy change rows, if the iteration may change any, and take the step of the exposures."""
        run = self._run
        if at.changes:
            run.strategy.change_rows(at)
        if at.steps:  # as in the reference, the last iteration takes no step
            run.gaussians.exposures.step()
            run.after_step(at)
