"""The ways to take a step of training: all give the same bytes."""

from splatting.training.run import Run
from splatting.training.steps.captured import CapturedStep
from splatting.training.steps.fused import FusedStep
from splatting.training.steps.plain import PlainStep


def step_taker(run: Run) -> PlainStep:
    """The fastest way to take the steps of this run.

    It is the plain one where somebody else may need gradients.
    """
    if not FusedStep.suits(run):
        return PlainStep(run)
    exchanges = run.gaussians.shards.ranks.several  # numbers, in each step
    runs_ahead = run.device.type == "cuda" and not exchanges and run.counts is None
    return CapturedStep(run) if runs_ahead else FusedStep(run)
