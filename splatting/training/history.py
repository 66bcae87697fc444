"""Traces of earlier runs, in the output folder and next to the checkpoint being resumed."""

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from arguments import OPTIONS, read_model_json, read_stored_options
from splatting.evaluation import training_log
from splatting.evaluation.error_curve import Row, continue_curve
from splatting.evaluation.training_log import TrainingLog
from utils.system_utils import UserError, saved_iterations

VIEWS = "views_per_iteration"  # entry of model.json, where it is not 1


def check_folder(
    model_path: str, source_path: str, saving_iterations: Sequence[int], checkpoint: str | None, first_iteration: int
) -> None:
    """Refuse a folder with a model of another scene (UserError): training would mix both.

    Warn of iterations that an earlier training of this scene has saved and this one does not overwrite.
    """
    folder = Path(model_path)
    saved = saved_iterations(folder / "point_cloud")
    if not lies_in(checkpoint, folder) and (saved or any(folder.glob("chkpnt*.pth"))):
        trained_on = _options_of(folder).get("source_path")
        if trained_on and not _same_place(trained_on, source_path):
            raise UserError(
                f"{model_path} holds a model of another scene, {trained_on}; name another folder with -m, or remove "
                "that one"
            )
    stay = [iteration for iteration in saved if iteration > first_iteration and iteration not in saving_iterations]
    if stay:
        print(
            f"warning: {folder / 'point_cloud'} keeps iteration {', '.join(map(str, stay))} of an earlier training, "
            "and render.py takes the highest unless --iteration is given; remove the old ones, or name another folder "
            "with -m",
            file=sys.stderr,
        )


def lies_in(checkpoint: str | None, folder: str | os.PathLike) -> bool:
    """Whether a checkpoint, if there is one, lies in a model folder."""
    return checkpoint is not None and _same_place(Path(checkpoint).parent, folder)


def check_views(checkpoint: str, views: int) -> None:
    """UserError if the run that wrote a checkpoint had another number of views in each iteration than this run."""
    then = read_model_json(str(Path(checkpoint).parent)).get(VIEWS, 1)
    if then != views:
        how = f"--parallel views and {then} processes" if then > 1 else "--parallel tiles"
        raise UserError(
            f"{checkpoint} is of a run that had {then} views in each iteration, and this one would have {views}; "
            f"resume it with {how}"
        )


def report_changes(checkpoint: str, now: argparse.Namespace) -> None:
    """Warn if the run that wrote a checkpoint had other options than this run, `now`.

    now: all options. Those that the checkpoint's folder does not record are not compared.
    """
    folder = Path(checkpoint).parent
    then = _options_of(folder)
    names = [option.name for option in OPTIONS if option.compared and option.name in then]
    changed = [name for name in names if not _equal(name, then[name], getattr(now, name))]
    if changed:
        before, after = (" ".join(_typed(n, of[n]) for n in changed) for of in (then, vars(now)))
        print(f"warning: {folder} was trained with {before}, this run has {after}", file=sys.stderr)


def continue_records(model_path: str, checkpoint: str | None, first_iteration: int) -> tuple[TrainingLog, list[Row]]:
    """The log of a training and the rows of its curve up to `first_iteration`; none for a training from the start.

    Both are read from the checkpoint's folder if that has a log, else from model_path. This run continues them
    in model_path.
    """
    before = Path(model_path)
    if checkpoint and (Path(checkpoint).parent / training_log.NAME).is_file():
        before = Path(checkpoint).parent
    log, rows = TrainingLog(model_path, first_iteration, before), continue_curve(model_path, first_iteration, before)
    if rows:  # after a rescue the curve has rows beyond the log's last record
        log.not_before(rows[-1])
    elif checkpoint and not log.records:
        print(
            f"there is no {training_log.NAME} beside {checkpoint}: seconds count from iteration {first_iteration}, "
            "in the curve too",
            file=sys.stderr,
        )
    return log, rows


def _options_of(folder: Path) -> dict[str, object]:
    """Training options that a folder records; none if they cannot be read, as in a folder without a model."""
    with contextlib.suppress(UserError, OSError):
        return read_stored_options(folder)
    return {}


def _equal(name: str, then: object, now: object) -> bool:
    return _same_place(then, now) if name == "source_path" else then == now


def _same_place(one: str | os.PathLike, other: str | os.PathLike) -> bool:
    return os.path.realpath(one) == os.path.realpath(other)


def _typed(name: str, value: object) -> str:
    """Format an option as it is typed on a command line."""
    if isinstance(value, bool):
        return f"--{name}" if value else f"no --{name}"
    return f"--{name} {value if value != '' else repr(value)}"
