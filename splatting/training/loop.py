"""The training loop: the method, and nothing else."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch

from splatting.distributed.ranks import ranks
from splatting.training.observer import Announcer, Observer
from splatting.training.run import Run
from splatting.training.steps.choose import Taker, step_taker
from splatting.training.together import Together


def run_training(run: Run, observers: Sequence[Observer]) -> None:
    """Take the steps (training/steps/plain.py): render a view, follow the gradient of its loss, control density.

    Whatever else happens is an observer's business, in the order of the list (training/observers/standard.py).
    Raises KeyboardInterrupt or Terminated, after a complete step, if a signal asked for it.
    """
    taker, together = step_taker(run), Together(run)
    tell = Announcer([together, *observers] if ranks().several else observers)
    with run.interrupt, tell, _backward_on_this_thread(), _whole_steps(run, taker):
        for step in run.steps():
            tell.begins(step)
            taker.make_ready(step)  # before the learning rates are set, which a repeated step changes
            run.prepare(step)  # learning rates, SH degree, photos of the next views
            taker.take(step, tell)
            step.stopping = together.stopping  # read once: a signal may come at any moment
            if step.stopping:
                taker.settle()
            tell.stepped(step)
            if step.stopping:
                together.wait()
                raise step.stopping
    together.finish()
    tell.ended()  # out here a signal stops at once what is only drawn and printed


@contextmanager
def _whole_steps(run: Run, taker: Taker) -> Iterator[None]:
    """After an error, leave the model as it was between two steps."""
    try:
        yield
    except BaseException:
        run.lost = taker.give_up()
        raise


@contextmanager
def _backward_on_this_thread() -> Iterator[None]:
    """Run backward on this thread; waking autograd's worker thread costs time in every iteration."""
    with torch.autograd.set_multithreading_enabled(False):
        yield
