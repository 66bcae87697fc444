"""The training loop: the method, and nothing else."""

from collections.abc import Iterator, Sequence

import torch

from gaussian_renderer.memory_errors import memory_errors_explained
from splatting.part import Part
from splatting.training.announcer import Announcer
from splatting.training.iteration import Iteration
from splatting.training.run import Run
from splatting.training.step_agreement import StepAgreement
from splatting.training.steps import step_taker
from splatting.training.steps.plain import PlainStep

_REMEDY = "lower --resolution (-r), --max_num_splats or --images_to_load, and resume from the last checkpoint"


def run_training(run: Run, observers: Sequence[Part]) -> None:
    """Take the steps (training/steps): render a view, follow the gradient of its loss, control density.

    Whatever else happens is an observer's business, in the order of the list (training/observers/standard.py).
    Raises KeyboardInterrupt or Terminated, after a complete step, if a signal asked for it.
    """
    for _ in training_steps(run, observers):
        pass


def training_steps(run: Run, observers: Sequence[Part]) -> Iterator[tuple[Iteration, PlainStep]]:
    """`run_training` by iterations. Yields each, and the taker of its step.

    Once that is drained, and within `run.flushed_view()`, others may read the model.
    """
    step, barrier = step_taker(run), StepAgreement(run)
    announcer = Announcer([barrier, *observers], run.flushed_view)
    at = None
    try:
        # Backward runs on this thread: waking autograd's worker costs time in every iteration.
        explained = memory_errors_explained(run.gaussians, run.views.cameras, _REMEDY, "training")
        with explained, run.interrupt, announcer, torch.autograd.set_multithreading_enabled(False):
            try:
                for at in run.iterations():
                    announcer.begins(at)
                    step.throttle(at)  # before the learning rates are set, which a replayed step changes
                    run.prepare(at)  # learning rates, SH degree, photos of the next views
                    step.take(at, announcer)
                    at.stopping = barrier.stopping  # read once: a signal may come at any moment
                    if at.stopping:
                        step.drain()
                    announcer.stepped(at)
                    if at.stopping:
                        raise at.stopping
                    yield at, step
            except BaseException:
                step.abort()
                raise
    except KeyboardInterrupt:
        if at is not None and at.stopping:
            barrier.wait()
        raise
    announcer.ended()  # out here a signal stops at once what is only drawn and printed
