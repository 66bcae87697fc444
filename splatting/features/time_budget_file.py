"""Files of schedules: schedule.json, and the schedule that a run follows by its options.

schedule.json tells how a run with --time_budget went through its schedule, so that another run can do the same.
Checkpoints of the run hold the same table, from which a resumed run goes on.
"""

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from groundwork.files.json_files import SCHEDULE, read_json, write_json
from splatting.features.time_budget_schedule import AUTO, Block, Continued, Decided, DecidedSchedule, TimeBudget
from utils.system_utils import UserError

_SIZES = "resolution_schedule"  # key of the sizes of views
_MOST = 2**31 - 1  # iterations, as of --iterations
_BROKEN = ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError, RecursionError


def table_of(decided: Decided) -> dict[str, Any]:
    """Return a schedule as plain values, for a file or a checkpoint."""
    lists = {name: [one._asdict() for one in getattr(decided, name)] for name in ("blocks", "continued")}
    table = decided._asdict() | lists
    return {_SIZES if name == "sizes" else name: value for name, value in table.items()}


def write_schedule(path: Path, decided: Decided) -> None:
    """Write a schedule, the whole file or none."""
    write_json(path, table_of(decided))


def read_schedule(path: Path) -> Decided:
    """Read the schedule of a file. UserError if the file is missing or broken."""
    remedy = f"name the {SCHEDULE} of a run with --time_budget"
    try:
        return _parse_schedule(read_json(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {remedy}") from error
    except _BROKEN as error:
        raise UserError(f"{path} is not a valid {SCHEDULE} ({_describe_error(error)}); {remedy}") from error


def _describe_error(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def _parse_schedule(content: Any) -> Decided:
    """Return the schedule that a table of schedule.json or of a checkpoint describes.

    Raises one of the errors in _BROKEN for a damaged table, such as one whose progress does not ascend.

    content: table that `table_of` has made, or whatever a damaged file has in its place.
    """
    if not isinstance(content, dict):
        raise ValueError("it is not a table")
    length, ended = _check_whole(content["iterations"], 1), content["ended"]
    blocks = [_parse_block(one) for one in content["blocks"]]
    lasts, starts = [0, *(block.last for block in blocks)], [block.start for block in blocks]
    continued = [
        Continued(_check_whole(one["after"], 1), _check_number(one["seconds"], 0.0))
        for one in content.get("continued", ())
    ]
    falls = {last for last, now, then in zip(lasts[1:], starts, starts[1:], strict=False) if then < now}
    if sorted(set(lasts)) != lasts or not blocks:
        raise ValueError("its blocks do not follow each other")
    if falls - {one.after for one in continued}:
        raise ValueError("its progress does not ascend")
    if ended is not None and _check_whole(ended, 1) != lasts[-1]:
        raise ValueError("its last block does not end with its last iteration")
    levels = [(_check_number(part, 0.0), _check_number(factor, 1.0)) for part, factor in content["levels"]]
    if levels != sorted(levels):
        raise ValueError("its levels do not ascend")
    from arguments.features import strategies  # at run time alone, as `Scene` of other programs may load this module

    if (strategy := content.get("strategy", "")) not in ("", *strategies()):
        raise ValueError(f"{strategy!r} is no strategy")
    begun = content.get("begun", 0.0)
    named = str(content[_SIZES]), levels, strategy, (*continued,), None if begun is None else _check_number(begun, 0.0)
    decided = Decided(length, blocks, ended, _check_number(content["time_budget"], 0.0), *named)
    if max(map(DecidedSchedule(decided).progress, lasts)) > 1 + 1e-6:
        raise ValueError("its progress goes beyond its end")
    return decided


def _parse_block(one: dict[str, Any]) -> Block:
    numbers = [_check_number(one[name], 0.0) for name in ("start", "step", "seconds")]
    return Block(_check_whole(one["last"], 1), *numbers)


def _check_whole(value: Any, least: int) -> int:
    if type(value) is not int or not least <= value <= _MOST:
        raise ValueError(f"{value!r} is no whole number from {least} to {_MOST}")
    return value


def _check_number(value: Any, least: float) -> float:
    if type(value) not in (int, float) or not (math.isfinite(value) and value >= least):
        raise ValueError(f"{value!r} is no number from {least:g} on")
    return float(value)


def schedule_of(
    opt: argparse.Namespace,
    checkpoint: str | None,
    first_iteration: int,
    share: Callable[[float], float] = lambda seconds: seconds,
    before: Any = None,
) -> DecidedSchedule:
    """Return the schedule of a run. UserError for a schedule that this run cannot follow.

    checkpoint: path of the chkpntN.pth that is resumed, or None.
    first_iteration: its N, or 0.
    share: function that gives all processes the seconds of one.
    before: table in the checkpoint, or None.
    """
    if opt.schedule and opt.time_budget:
        raise UserError("--time_budget and --schedule both set the schedule; leave one of them out")
    if opt.schedule.isdecimal() and not Path(opt.schedule).exists():
        return DecidedSchedule(_divide_evenly(int(opt.schedule), opt))
    if opt.schedule:
        return DecidedSchedule(_read_recorded(Path(opt.schedule), opt))
    if not first_iteration:
        return TimeBudget(Decided(opt.iterations, [], None, opt.time_budget, AUTO), share)
    found = _resume_schedule(before, checkpoint, opt, first_iteration)
    return TimeBudget(_add_seconds(found, opt.time_budget), share)


def _add_seconds(found: Decided, seconds: float) -> Decided:
    """Return a schedule to resume with a limit of seconds; a finished one gets so many seconds more."""
    *earlier, last = found.continued or [None]
    if found.ended is not None:
        more = *found.continued, Continued(found.ended, seconds)
        return found._replace(continued=more, ended=None, begun=None)
    if last:
        return found._replace(continued=(*earlier, last._replace(seconds=seconds)))
    return found._replace(time_budget=seconds)


def _divide_evenly(count: int, opt: argparse.Namespace) -> Decided:
    """Return a schedule that `count` iterations go through in equal parts, with no budget of seconds."""
    if not 1 <= count <= _MOST:
        raise UserError(f"--schedule must name iterations between 1 and {_MOST}, or a file, got {count}")
    return Decided(opt.iterations, [Block(count, 0.0, 1 / count, 0.0)], count, 0.0)


def _read_recorded(path: Path, opt: argparse.Namespace) -> Decided:
    found = _check_fit(read_schedule(path), path, opt)
    if found.ended is None:
        raise UserError(f"{path}: run not finished; resume it, or give the {SCHEDULE} of a finished run")
    return found


def _check_fit(found: Decided, path: Path | str, opt: argparse.Namespace) -> Decided:
    """Return a schedule of a file, or raise UserError if the options do not fit it."""
    if found.iterations != opt.iterations:
        raise UserError(
            f"{path} was written for --iterations {found.iterations}, not {opt.iterations}; give --iterations "
            f"{found.iterations}"
        )
    return found


def _resume_schedule(before: Any, checkpoint: str, opt: argparse.Namespace, first_iteration: int) -> Decided:
    """Return the decisions of the runs that are resumed, up to the checkpoint's iteration.

    A checkpoint without a schedule is of a run without a time budget, whose iterations were those of the schedule: it
    stands for one block of them.

    before: the schedule as the checkpoint keeps it, or None.
    first_iteration: iteration of the checkpoint.
    """
    if before is None:
        over = first_iteration if first_iteration >= opt.iterations else None
        if not over:
            told = f"{checkpoint} was trained without --time_budget; it is iteration {first_iteration} of the schedule"
            print(told, file=sys.stderr)
        block = Block(first_iteration, 0.0, 1.0 / max(opt.iterations, first_iteration), 0.0)
        return Decided(opt.iterations, [block], over, 0.0, AUTO)
    try:
        found = DecidedSchedule(_parse_schedule(before)).up_to(first_iteration)
    except _BROKEN as error:
        raise UserError(
            f"the schedule in {checkpoint} is broken ({_describe_error(error)}); give another one"
        ) from error
    return _check_fit(found, checkpoint, opt)
