"""Faster forms of the plain step. All give the same bytes."""

from splatting.faster.captured import CapturedStep
from splatting.faster.faster import FasterSteps
from splatting.faster.fused import FusedStep
from splatting.run import Run


def faster_steps(run: Run) -> FasterSteps:
    """Return the fastest steps for this run.

    Where somebody else may need gradients, all steps are plain.
    """
    if not FusedStep.suits(run):
        return FasterSteps()
    exchanges = run.gaussians.shards.ranks.several  # numbers, in each step
    runs_ahead = run.device.type == "cuda" and not exchanges and run.pixel_filter is None
    return CapturedStep(run) if runs_ahead else FusedStep(run)
