"""The training loop: the method, and nothing else."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch

from gaussian_renderer import render
from training.observer import Announcer, Observer
from training.run import Run
from utils.host.interrupt import DeferredInterrupt


def run_training(run: Run, observers: Sequence[Observer]) -> None:
    """Render a view, compare it with its photo, follow the gradient, control density, step.

    Whatever else happens is an observer's business, in the order of the list (training/observers/standard.py).
    Raises KeyboardInterrupt or Terminated, after a complete step, if a signal asked for it.
    """
    tell = Announcer(observers)
    with DeferredInterrupt() as interrupt, tell, _backward_on_this_thread():
        for step in run.steps():
            tell.begins(step)
            run.prepare(step)  # learning rates, SH degree, photos of the next views

            package = render(step.camera, run.gaussians, run.pipe, step.background, **run.render_options(step))
            losses = run.objective(package, step)
            losses.total.backward()
            tell.measured(step, losses)

            run.density.after_backward(step, package)
            if not step.last:  # as in the reference, the last iteration takes no step
                run.gaussians.step(package["radii"])
                run.density.after_step(step)
            step.stopping = interrupt.requested  # read once: a signal may come at any moment
            tell.stepped(step)
            if step.stopping:
                raise step.stopping
    tell.ended()  # out here a signal stops at once what is only drawn and printed


@contextmanager
def _backward_on_this_thread() -> Iterator[None]:
    """Run backward on this thread; waking autograd's worker thread costs time in every iteration."""
    with torch.autograd.set_multithreading_enabled(False):
        yield
