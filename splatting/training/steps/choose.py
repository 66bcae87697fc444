"""The choice of how steps are taken."""

from typing import TypeAlias

import torch

from scene.spilled_model import SpilledGaussians
from splatting.distributed.ranks import ranks
from splatting.training.run import Run
from splatting.training.steps.ahead import AheadStep
from splatting.training.steps.fused import FusedStep
from splatting.training.steps.plain import PlainStep
from splatting.training.steps.spilled import SpilledStep
from splatting.training.steps.views import ViewsStep

Taker: TypeAlias = PlainStep | FusedStep | AheadStep


def step_taker(run: Run) -> Taker:
    """The fastest way to take the steps of this run.

    The plain one where the user asks for it (--plain_step, --detect_anomaly), and for an objective or a density control
    that is not ours: it may want gradients, or wait for values that the GPU has not computed yet. With --spill that of
    a part of the model.
    """
    if run.pace.views > 1:
        return ViewsStep(run)
    if isinstance(run.gaussians, SpilledGaussians):
        return SpilledStep(run)
    if run.launch.plain_step or torch.is_anomaly_enabled() or not FusedStep.suits(run):
        return PlainStep(run)
    runs_ahead = run.device.type == "cuda" and not ranks().several  # ranks tell each other numbers in each step
    return AheadStep(run) if runs_ahead else FusedStep(run)
