"""The choice of how steps are taken."""

from typing import TypeAlias

import torch

from training.density import AdaptiveDensityControl
from training.objective import Objective
from training.run import Run
from training.steps.ahead import AheadStep
from training.steps.plain import PlainStep

Taker: TypeAlias = PlainStep | AheadStep


def step_taker(run: Run) -> Taker:
    """The fastest way to take the steps of this run.

    The plain one where the user asks for it (--plain_step, --detect_anomaly), and for an objective or a density control
    that is not ours: it may wait for values that the GPU has not computed yet.
    """
    ours = type(run.objective) is Objective and type(run.density) is AdaptiveDensityControl
    plain = run.plan.plain_step or torch.is_anomaly_enabled() or not ours
    return PlainStep(run) if plain or run.device.type != "cuda" else AheadStep(run)
