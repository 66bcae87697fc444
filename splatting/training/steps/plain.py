"""The plain step: autograd, with every gradient of every parameter there for whoever wants it."""

from torch import Tensor

from gaussian_renderer import draw, exposed, in_world_units, render, wake
from splatting.training.announcer import Announcer
from splatting.training.iteration import Iteration, Losses
from splatting.training.run import Run

Package = dict[str, Tensor | None]


class OneView:
    """Renders the iteration's view."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def render(self, at: Iteration) -> Package:
        """The result of `render`, with what the loss needs."""
        run = self._run
        return render(at.camera, run.gaussians, run.pipe, at.background, **run.render_options(at))

    def collect(self, at: Iteration, package: Package, losses: Losses) -> tuple[Package, Losses]:
        """Called after backward: give the model its gradients; the package of all its rows, and the losses to show."""
        return package, losses


class RefinedView(OneView):
    """Renders a view whose pose is trained, too, and takes the pose's step."""

    def render(self, at: Iteration) -> Package:
        run, options = self._run, self._run.render_options(at)
        exposes = options.pop("use_trained_exp")
        package = render(at.camera, run.gaussians, run.pipe, at.background, **options)
        self._planes = package["render"], package["depth"]
        for plane in self._planes:
            if plane is not None:
                plane.retain_grad()
        if exposes:
            package["render"] = exposed(package["render"], at.camera, run.gaussians)
        return package

    def collect(self, at: Iteration, package: Package, losses: Losses) -> tuple[Package, Losses]:
        run = self._run
        if at.steps:
            color, depth = (None if plane is None else plane.grad for plane in self._planes)
            drawn = draw(at.camera, run.gaussians, run.pipe, at.background, depth is not None)
            run.step_on_host(at, drawn.camera_gradient(color, in_world_units(depth, run.gaussians)))
        return package, losses


class PlainStep:
    """Renders a view, compares it with its photo, follows the gradient, controls density, steps the optimisers.

    A faster step is a subclass, and falls back on this one. Where steps are queued on a GPU, `throttle` waits until
    another may be, `drain` until all are done, and `abort`, after an error, until the GPU has stopped. A plain step
    leaves nothing pending.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._view = (RefinedView if run.on_host else OneView)(run)

    def take(self, at: Iteration, observers: Announcer) -> None:
        """Take a step; the observers are told once the gradients are there."""
        run = self._run
        if run.on_host:
            run.on_host.place(at.camera)
        if run.sleeping:
            self._wake(at)
        package = self._view.render(at)
        losses = run.objective(package, at)
        losses.total.backward()
        if self._reaches_sleepers():
            self._stop_skipping()
            return self.take(at, observers)
        package, losses = self._view.collect(at, package, losses)
        if any(run.density.penalty):
            run.gaussians.penalise(run.density.penalty)
        observers.measured(at, losses)
        run.density.after_backward(at, package)
        if at.steps:  # as in the reference, the last iteration takes no step
            run.gaussians.step(package["radii"])
            run.after_step(at)

    def _wake(self, at: Iteration) -> None:
        """Wake the blocks that the step concerns: all, where rows change or nothing follows."""
        run = self._run
        if at.changes or not at.steps:
            run.sleeping.flush()
        else:
            wake(run.sleeping, at.camera, run.gaussians, run.pipe, at.background)
            run.gaussians.optimizer.rows = run.sleeping.rows()

    def _reaches_sleepers(self) -> bool:
        """Whether the loss depends on a row that sleeps: somebody has added a term to it."""
        rows = self._run.sleeping and self._run.gaussians.optimizer.rows
        if rows is None:
            return False
        gaussians, asleep = self._run.gaussians, ~rows
        gradients = [gaussians.raw(name).grad for name in gaussians._attributes]
        return any(bool(gradient[asleep].any()) for gradient in gradients if gradient is not None)

    def _stop_skipping(self) -> None:
        """Let all blocks wake for good, and drop the gradients of a step that will be taken again."""
        self._drop_gradients()
        self._run.gaussians.optimizer.rows = None
        self._run.stop_skipping()

    def _drop_gradients(self) -> None:
        gaussians = self._run.gaussians
        gaussians.optimizer.zero_grad(set_to_none=True)
        gaussians.exposures.optimizer.zero_grad(set_to_none=True)

    def throttle(self, at: Iteration) -> None:
        pass

    def drain(self) -> None:
        pass

    def abort(self) -> None:
        pass
