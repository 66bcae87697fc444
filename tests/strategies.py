"""Strategies of density control that have begun, for tests without a run."""

import argparse
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
from gaussians import options

from groundwork.ranks.rows import WHOLE
from scene.gaussians.exposure import Exposures
from splatting.part import Strategy
from splatting.registry import strategy_part
from splatting.schedule import STEADY, Schedule


def begun(
    name: str,
    gaussians: Any = None,
    opt: argparse.Namespace | None = None,
    schedule: Schedule = STEADY,
    *,
    white: bool = False,
    extent: float = 1.0,
    cameras: Sequence[Any] = (),
    parts: Sequence[Any] = (),
    starts: bool = False,
) -> Strategy:
    """The strategy of this name in a run of a model (None: of one that has no rows), of these cameras and parts.

    starts: the model is made of points.
    """
    info = SimpleNamespace(ply_path=None)
    run = SimpleNamespace(
        gaussians=gaussians
        or SimpleNamespace(shards=WHOLE, exposures=Exposures(), enlargement=1.0, step_sparsely=lambda: None),
        opt=opt or options(),
        pipe=None,
        parts=parts,
        starts_from_points=starts,
        schedule=schedule,
        dataset=SimpleNamespace(white_background=white),
        scene=SimpleNamespace(cameras_extent=extent, info=info, getTrainCameras=lambda: cameras),
        device=torch.device("cpu"),
    )
    strategy = strategy_part(name)
    strategy.begin(run, None)
    return strategy
