"""The schedule that a run follows, by its options, and schedule.json.

schedule.json tells how a run with --time_budget went through its schedule, so that another one can do the same.
"""

import argparse
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from arguments.strategies import STRATEGIES
from splatting.files.json_files import read_json, write_json
from splatting.training.schedule import (
    PYRAMID,
    Block,
    Decided,
    DecidedSchedule,
    Schedule,
    SettlingSchedule,
    TimeBudget,
)
from utils.system_utils import UserError

NAME = "schedule.json"
_MOST = 2**31 - 1  # iterations, as of --iterations


def write_schedule(path: Path, decided: Decided) -> None:
    """Write the whole file or none."""
    write_json(path, decided._asdict() | {"blocks": [block._asdict() for block in decided.blocks]})


def read_schedule(path: Path, remedy: str = f"name the {NAME} of a run with --time_budget") -> Decided:
    """The schedule of a file. UserError, which ends with the remedy, if it is missing or broken."""
    try:
        return _decided(read_json(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {remedy}") from error
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise UserError(f"{path} is no schedule of a run ({_reason(error)}); {remedy}") from error


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def leave_schedule(folder: Path, iteration: int) -> None:
    """Let the schedule of a folder end with an iteration, from which a run without a time budget goes on; 0: remove it.

    Checkpoints up to there keep their place in it. A broken file stays as it is.
    """
    path = folder / NAME
    if not iteration:
        return path.unlink(missing_ok=True)
    with suppress(UserError):
        found = read_schedule(path)
        if found.blocks[-1].last >= iteration:
            write_schedule(path, DecidedSchedule(found).up_to(iteration))


def covers(path: Path, iteration: int) -> bool:
    """Whether an iteration was one of the run of a schedule; True for a broken file, False without one."""
    try:
        return path.exists() and read_schedule(path).blocks[-1].last >= iteration
    except UserError:
        return True


def _decided(content: Any) -> Decided:
    if not isinstance(content, dict):
        raise ValueError("it is not a table")
    length, ended = _whole(content["iterations"], 1), content["ended"]
    blocks = [_block(one) for one in content["blocks"]]
    lasts, starts = [0, *(block.last for block in blocks)], [block.start for block in blocks]
    if sorted(set(lasts)) != lasts or not blocks:
        raise ValueError("its blocks do not follow each other")
    if starts != sorted(starts):
        raise ValueError("its progress does not ascend")
    if ended is not None and _whole(ended, 1) != lasts[-1]:
        raise ValueError("its last block does not end with its last iteration")
    levels = [(_number(part, 0.0), _number(factor, 1.0)) for part, factor in content["levels"]]
    if levels != sorted(levels):
        raise ValueError("its levels do not ascend")
    if (strategy := content.get("strategy", "")) not in ("", *STRATEGIES):
        raise ValueError(f"{strategy!r} is no strategy")
    named = str(content["resolution_schedule"]), levels, strategy
    decided = Decided(length, blocks, ended, _number(content["time_budget"], 0.0), *named)
    if max(map(DecidedSchedule(decided).progress, lasts)) > 1 + 1e-6:
        raise ValueError("its progress goes beyond its end")
    return decided


def _block(one: dict[str, Any]) -> Block:
    numbers = [_number(one[name], 0.0) for name in ("start", "step", "seconds")]
    return Block(_whole(one["last"], 1), *numbers)


def _whole(value: Any, least: int) -> int:
    if type(value) is not int or not least <= value <= _MOST:
        raise ValueError(f"{value!r} is no whole number from {least} to {_MOST}")
    return value


def _number(value: Any, least: float) -> float:
    if type(value) not in (int, float) or not (math.isfinite(value) and value >= least):
        raise ValueError(f"{value!r} is no number from {least:g} on")
    return float(value)


def schedule_of(
    opt: argparse.Namespace,
    checkpoint: str | None,
    first_iteration: int,
    share: Callable[[float], float] = lambda seconds: seconds,
) -> Schedule:
    """The schedule of a run. UserError for one that this run cannot follow, or that leaves nothing to do.

    checkpoint: a chkpntN.pth that is resumed, or None. first_iteration: its N, or 0.
    share: gives all processes the seconds of one.
    """
    schedule = _chosen(opt, checkpoint, first_iteration, share)
    if not schedule.is_over(first_iteration):
        return schedule
    at = f"{checkpoint} is at iteration {first_iteration}"
    if isinstance(schedule, DecidedSchedule):
        raise UserError(
            f"{at}, and its schedule ends with {schedule.ends}, so nothing is left to do; leave it as it is"
        )
    raise UserError(
        f"{at}, so --iterations {opt.iterations} leaves nothing to do; --iterations counts from the start of the first "
        "run"
    )


def _chosen(
    opt: argparse.Namespace, checkpoint: str | None, first_iteration: int, share: Callable[[float], float]
) -> Schedule:
    if opt.schedule.isdecimal() and not Path(opt.schedule).exists():
        return DecidedSchedule(_even(int(opt.schedule), opt))
    if opt.schedule:
        return DecidedSchedule(_recorded(Path(opt.schedule), opt))
    path = Path(checkpoint).parent / NAME if checkpoint else None
    if not opt.time_budget:
        if path and covers(path, first_iteration):
            _tell_of_budget(checkpoint, first_iteration, opt.iterations)
        return SettlingSchedule(opt.iterations) if opt.strategy == "budget" else Schedule(opt.iterations)
    if not path:
        return TimeBudget(Decided(opt.iterations, [], None, opt.time_budget, opt.resolution_schedule), share)
    before = _before(path, checkpoint, opt, first_iteration)
    return TimeBudget(before._replace(time_budget=opt.time_budget), share)


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


def _even(count: int, opt: argparse.Namespace) -> Decided:
    """The schedule that so many iterations go through in equal parts, with no budget of seconds."""
    if opt.time_budget:
        raise UserError("--time_budget and --schedule both give the pace of a run; leave one out")
    if not 1 <= count <= _MOST:
        raise UserError(f"--schedule must name iterations between 1 and {_MOST}, or a file, got {count}")
    sizes = "none" if opt.resolution_schedule == "auto" else opt.resolution_schedule
    levels = PYRAMID if sizes == "pyramid" else ()
    return Decided(opt.iterations, [Block(count, 0.0, 1 / count, 0.0)], count, 0.0, sizes, levels)


def _recorded(path: Path, opt: argparse.Namespace) -> Decided:
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


def _read(path: Path, opt: argparse.Namespace, *remedy: str) -> Decided:
    found = read_schedule(path, *remedy)
    if found.iterations != opt.iterations:
        raise UserError(
            f"{path} is of a schedule of {found.iterations} iterations, not {opt.iterations}; give --iterations "
            f"{found.iterations}, as in the run that wrote it"
        )
    return found


def _before(path: Path, checkpoint: str, opt: argparse.Namespace, first_iteration: int) -> Decided:
    """The schedule so far of the runs that are resumed; one block if they had no budget."""
    if not path.exists():
        step = 1.0 / max(opt.iterations, first_iteration + 1)
        return Decided(opt.iterations, [Block(first_iteration, 0.0, step, 0.0)], None, 0.0, opt.resolution_schedule)
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
    return DecidedSchedule(found).up_to(first_iteration)
