"""What the options and files of a training decide before there is a scene, and what they let refuse by then."""

import argparse
import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from groundwork.ranks.ranks import Ranks, ranks
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import extra_state, load_checkpoint
from scene.readers.point_cloud import read_point_cloud
from scene.with_splats import read_start
from splatting import folder
from splatting.checks import check_alone, check_viewer
from splatting.part import Part
from splatting.registry import check_together, chosen, states_in, strategies
from splatting.run import join_options
from splatting.schedule import Schedule
from splatting.spill import make_storage
from utils.system_utils import UserError, compute_device


class Plan(NamedTuple):
    """What the options and files say of a run before there is a scene. For the fields see Run.

    capture: model in the checkpoint, states: those of parts there; None and {} without one.
    init_ply: file to start from, or None.
    """

    dataset: argparse.Namespace
    opt: argparse.Namespace
    group: Ranks
    device: torch.device
    start: str | None
    capture: tuple | None
    done: int
    states: dict[str, Any]
    parts: list[Part]
    schedule: Schedule
    gaussians: GaussianModel
    init_ply: str | None


def plan_run(
    dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
) -> Plan:
    """Plan a run. Refuse what can be refused without its scene (UserError); parameters as for make_run."""
    opt = copy.copy(opt)  # of which the strategy, and windows by the clock, are decided here
    group, device = ranks(), compute_device()
    check_alone(pipe, launch, group.several)
    start = group.broadcast_object(folder.resumed(launch.start_checkpoint, dataset.model_path, opt.iterations))
    folder.refuse_other_scene(dataset, start)
    dataset = folder.resolve_lenses(dataset, start)
    if opt.strategy == "auto" and start:
        opt.strategy = folder.strategy_of(start)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    # A large model fits on the device only once, or in part; of several processes, each keeps its part there.
    capture, done = load_checkpoint(start, mapped=group.several) if start else (None, 0)
    states = states_in(extra_state(capture)) if capture else {}
    parts = chosen(together := join_options(launch, dataset, opt, pipe), states, done)
    check_together(parts, together, group.several)
    schedule = _make_schedule(parts, opt, start, done, states)
    gaussians.storage = make_storage(gaussians, opt, device, any(one.takes_absolute(opt) for one in strategies()))
    check_viewer(launch)
    if schedule.is_over(done):
        raise UserError(schedule.nothing_left_message(start, done))
    init_ply = None if start else getattr(dataset, "init_ply", None)
    return Plan(dataset, opt, group, device, start, capture, done, states, parts, schedule, gaussians, init_ply)


def check_before_scene(
    dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
) -> None:
    """Refuse options and files that a run would refuse (UserError), where its scene does not exist yet."""
    options, splats = read_start(plan_run(dataset, opt, pipe, launch).init_ply, dataset)
    if splats is None and (points := getattr(options, "init_pcd_path", "")):
        read_point_cloud(Path(points))


def _make_schedule(
    parts: Sequence[Part], opt: argparse.Namespace, start: str | None, done: int, states: dict[str, Any]
) -> Schedule:
    """Return the schedule of a part, or the steady one.

    A paced run has few iterations, and needs the last ones to train the Gaussians that it has. So densification ends by
    default at a part of the schedule, where it would end with the schedule.
    """
    found = [part.make_schedule(opt, start, done, states.get(part.name)) for part in parts]
    schedule = next(filter(None, found), None) or Schedule(opt.iterations)
    if schedule.paced:
        for name, share in {strategy.until for strategy in strategies()}:
            if getattr(opt, name) >= opt.iterations:
                setattr(opt, name, int(share * opt.iterations))
    return schedule
