"""The choice of a pace, by the options of a run."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from scene.cameras import Camera
from scene.images.store import ImageStore
from splatting.training.schedule.batched import Batched
from splatting.training.schedule.clocked import Clocked
from splatting.training.schedule.pace import PYRAMID, Block, Levels, Pace, Paced, Schedule, Settling
from splatting.training.schedule.resolution import Resolution
from splatting.training.schedule.schedule_file import NAME, covers, read_schedule
from splatting.training.schedule.spectrum import levels_of
from utils.system_utils import UserError


def pace_of(opt: argparse.Namespace, checkpoint: str | None, first_iteration: int, views: int = 1) -> Pace:
    """The pace of a run. UserError for a schedule that this run cannot follow, or that leaves nothing to do.

    checkpoint: a chkpntN.pth that is resumed, or None. first_iteration: its N, or 0. views: of each iteration.
    """
    pace = _chosen(opt, checkpoint, first_iteration) if views == 1 else _batched(opt, views)
    if not pace.is_over(first_iteration):
        return pace
    at = f"{checkpoint} is at iteration {first_iteration}"
    if isinstance(pace, Paced):
        raise UserError(f"{at}, and its schedule ends with {pace.ends}, so nothing is left to do; leave it as it is")
    raise UserError(
        f"{at}, so --iterations {opt.iterations} leaves nothing to do; --iterations counts from the start of the first "
        "run"
    )


def _batched(opt: argparse.Namespace, views: int) -> Pace:
    for name in ("schedule", "time_budget"):
        if getattr(opt, name):
            raise UserError(f"--{name} and --parallel views both give the pace of a run; leave one out")
    if opt.spill:
        raise UserError("--spill takes one view in each iteration; use --parallel tiles")
    return Batched(opt.iterations, views)


def _chosen(opt: argparse.Namespace, checkpoint: str | None, first_iteration: int) -> Pace:
    if opt.schedule:
        return Paced(_recorded(Path(opt.schedule), opt))
    path = Path(checkpoint).parent / NAME if checkpoint else None
    if not opt.time_budget:
        if path and covers(path, first_iteration):
            _tell_of_budget(checkpoint, first_iteration, opt.iterations)
        return Settling(opt.iterations) if opt.strategy == "budget" else Pace(opt.iterations)
    if not path:
        return Clocked(Schedule(opt.iterations, [], None, opt.time_budget, opt.resolution_schedule))
    return Clocked(_before(path, checkpoint, opt, first_iteration)._replace(time_budget=opt.time_budget))


def _tell_of_budget(checkpoint: str, first_iteration: int, iterations: int) -> None:
    """Warn that a run goes on without the time budget that it had; UserError if no iteration is left then."""
    if first_iteration >= iterations:
        raise UserError(
            f"{checkpoint} is at iteration {first_iteration} of a run with --time_budget, and without one --iterations "
            f"{iterations} leaves nothing to do; resume it with --time_budget"
        )
    print(
        f"warning: {checkpoint} is of a run with --time_budget, and this one has none: it goes on at iteration "
        f"{first_iteration} of {iterations}",
        file=sys.stderr,
    )


def _recorded(path: Path, opt: argparse.Namespace) -> Schedule:
    if opt.time_budget:
        raise UserError("--time_budget and --schedule both give the pace of a run; leave one out")
    found = _read(path, opt)
    if opt.resolution_schedule not in ("auto", found.resolution_schedule):
        raise UserError(
            f"{path} is of a run with --resolution_schedule {found.resolution_schedule}; leave that option out, as "
            "--schedule takes it from there"
        )
    if found.ended is None:
        raise UserError(f"{path} is of a run that did not end; resume that run, or name the {NAME} of another one")
    return found


def _read(path: Path, opt: argparse.Namespace, *remedy: str) -> Schedule:
    found = read_schedule(path, *remedy)
    if found.iterations != opt.iterations:
        raise UserError(
            f"{path} is of a schedule of {found.iterations} iterations, not {opt.iterations}; give --iterations "
            f"{found.iterations}, as in the run that wrote it"
        )
    return found


def _before(path: Path, checkpoint: str, opt: argparse.Namespace, first_iteration: int) -> Schedule:
    """The schedule so far of the runs that are resumed; one block if they had no budget."""
    if not path.exists():
        step = 1.0 / max(opt.iterations, first_iteration + 1)
        return Schedule(opt.iterations, [Block(first_iteration, 0.0, step, 0.0)], None, 0.0, opt.resolution_schedule)
    remedy = "move it elsewhere to resume that checkpoint as one of a run without a time budget"
    found = _read(path, opt, f"restore it for {checkpoint}, or {remedy}")
    if found.blocks[-1].last < first_iteration:
        raise UserError(
            f"{path} ends before iteration {first_iteration} of {checkpoint}, so it is of another run; {remedy}"
        )
    if opt.resolution_schedule not in ("auto", found.resolution_schedule):
        raise UserError(
            f"{checkpoint} is of a run with --resolution_schedule {found.resolution_schedule}; resume it with that"
        )
    if found.ended == first_iteration:
        return found
    return Paced(found).up_to(first_iteration)


def resolution_of(opt: argparse.Namespace, pace: Pace, cameras: Sequence[Camera], images: ImageStore) -> Resolution:
    """The sizes of the training views `cameras` by the options, or by the schedule that a run repeats or resumes."""
    if not isinstance(pace, Paced):
        pace.sizes = "none" if opt.resolution_schedule == "auto" else opt.resolution_schedule
    if not pace.levels:
        pace.levels = _levels(pace.sizes, cameras)
    return Resolution(pace, images)


def _levels(sizes: str, cameras: Sequence[Camera]) -> Levels:
    if sizes == "spectrum":
        return levels_of(cameras)
    return PYRAMID if sizes == "pyramid" else ()
