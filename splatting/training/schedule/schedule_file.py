"""schedule.json: how a run with --time_budget went through its schedule, so that another one can do the same."""

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

from splatting.files.json_files import read_json, write_json
from splatting.training.schedule.pace import Block, Paced, Schedule
from utils.system_utils import UserError

NAME = "schedule.json"


def write_schedule(path: Path, schedule: Schedule) -> None:
    """Write the whole file or none."""
    write_json(path, schedule._asdict() | {"blocks": [block._asdict() for block in schedule.blocks]})


def read_schedule(path: Path, remedy: str = f"name the {NAME} of a run with --time_budget") -> Schedule:
    """The schedule of a file. UserError, which ends with the remedy, if it is missing or broken."""
    try:
        return _schedule(read_json(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {remedy}") from error
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise UserError(f"{path} is no schedule of a run ({_reason(error)}); {remedy}") from error


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def leave_schedule(folder: Path, iteration: int) -> None:
    """Let the schedule of a folder end with an iteration, from which a run without a pace goes on; 0: remove it.

    Checkpoints up to there keep their place in it. A broken file stays as it is.
    """
    path = folder / NAME
    if not iteration:
        return path.unlink(missing_ok=True)
    with suppress(UserError):
        found = read_schedule(path)
        if found.blocks[-1].last >= iteration:
            write_schedule(path, Paced(found).up_to(iteration))


def covers(path: Path, iteration: int) -> bool:
    """Whether an iteration was one of the run of a schedule; True for a broken file, False without one."""
    try:
        return path.exists() and read_schedule(path).blocks[-1].last >= iteration
    except UserError:
        return True


def _schedule(content: Any) -> Schedule:
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
    named = str(content["resolution_schedule"]), levels
    schedule = Schedule(length, blocks, ended, _number(content["time_budget"], 0.0), *named)
    if max(map(Paced(schedule).progress, lasts)) > 1 + 1e-6:
        raise ValueError("its progress goes beyond its end")
    return schedule


def _block(one: dict[str, Any]) -> Block:
    numbers = [_number(one[name], 0.0) for name in ("start", "step", "seconds")]
    return Block(_whole(one["last"], 1), *numbers)


def _whole(value: Any, least: int) -> int:
    if type(value) is not int or value < least:
        raise ValueError(f"{value!r} is no whole number from {least} on")
    return value


def _number(value: Any, least: float) -> float:
    if type(value) not in (int, float) or not (math.isfinite(value) and value >= least):
        raise ValueError(f"{value!r} is no number from {least:g} on")
    return float(value)
