"""The folder of a training: its name, its lock, its checkpoints, and what earlier runs in the folder allow."""

import argparse
import contextlib
import copy
import os
import re
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from zipfile import is_zipfile

from arguments import OPTIONS, VIEW_OPTIONS, other_scene, read_training_options
from groundwork.applications import has_application
from groundwork.files.folders import locked, remove_temporary_files
from groundwork.files.json_files import ENLARGEMENT, SCHEDULE, read_model_json
from groundwork.host import torchrun
from groundwork.host.clock import seconds_since_start
from groundwork.host.listing import some
from groundwork.host.start import typed_command
from groundwork.ranks.ranks import ranks
from scene.saved_model import saves_in
from splatting.records import training_log
from splatting.records.error_curve import NAME as CURVE
from splatting.records.error_curve import Row, continue_curve
from splatting.records.training_log import TrainingLog
from utils.system_utils import UserError, atomic_write, mkdir_p

_RECORDS = ("cfg_args", "model.json", "cameras.json", "train_log.json", "error_vs_time.csv", "schedule.json")
_INPUTS = ("cfg_args", "model.json", "cameras.json", "input.ply")


def new_folder(scene: str = "") -> str:
    """Return a new folder under ./output: named by OAR_JOB_ID as in the reference, else after the scene's folder."""
    if job := os.environ.get("OAR_JOB_ID"):
        return os.path.join("./output/", ranks().broadcast_object(job)[:10])
    name = os.path.join("./output/", os.path.basename(os.path.realpath(scene)) or "model")
    names = (f"{name}_{number}" if number > 1 else name for number in count(1))
    return ranks().broadcast_object(next(new for new in names if not os.path.exists(new)))


def folder_of(checkpoint: str | None) -> str | None:
    """Return the model folder of a checkpoint. A resumed training continues there unless it names another folder."""
    folder = Path(checkpoint or "").parent
    return str(folder) if checkpoint and (folder / "cfg_args").is_file() else None


def view_command(model_path: str, iteration: int | None = None) -> str:
    """Return the command that shows a model, or renders it where there is no viewer.

    iteration: None, the newest one.
    """
    older = iteration is not None and max(saves_in(Path(model_path)), default=iteration) > iteration
    which = f" --iteration {iteration}" if older else ""
    script = "view.py" if has_application("viewer") else "render.py"
    return f"{typed_command(script)} -m {shlex.quote(model_path)}{which}"


@contextlib.contextmanager
def records_kept(model_path: str) -> Iterator[None]:
    """Put the records of a saved model back if an error ends a training in its folder before a new model is saved.

    Such an error may come late: a photo that cannot be read, for one, is found when it is needed. The first of several
    ranks does this for all.
    """
    folder = Path(model_path)
    saves = _read_stamps(folder) if ranks().first else {}
    kept = {name: (folder / name).read_bytes() for name in _RECORDS if saves and (folder / name).is_file()}
    try:
        yield
    except BaseException:
        if kept and _read_stamps(folder) == saves:
            for name, content in kept.items():
                with atomic_write(folder / name) as temporary:
                    temporary.write_bytes(content)
        raise


def _read_stamps(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in saves_in(folder).values()}


@contextlib.contextmanager
def own_folder(model_path: str) -> Iterator[None]:
    """Make the folder and lock it for this training. UserError if another train.py is at work in it.

    Temporary files of killed runs are removed first. A warning at the end says if files of the run are missing, as when
    somebody has removed the folder. The first of several ranks does this for all.
    """
    if not ranks().first:
        yield
        return
    folder = Path(model_path)
    mkdir_p(folder)
    with locked(folder, "train.py", "another train.py (process {process})", "-m"):
        remove_temporary_files(folder)
        yield
        missing = [name for name in _INPUTS if not (folder / name).exists()]
        if missing not in ([], ["input.ply"]):  # a run that is resumed may have begun without the latter
            print(
                f"warning: {some(missing)} in {folder} were removed during training; the model is saved, but other "
                "programs may need them",
                file=sys.stderr,
            )


REPLACED = "chkpnt_resume.pth"  # one that is replaced while the training goes on, never of its last iteration
_CHECKPOINT = re.compile(r"chkpnt(\d+)\.pth|" + re.escape(REPLACED))


def resumed(start: str | None, folder: str, iterations: int) -> str | None:
    """Return the checkpoint to begin with: `start`, or after a restart (--max-restarts) this training's newest one.

    A checkpoint that leaves nothing to do does not count.

    folder: output folder.
    """
    newest = newest_checkpoint(folder, iterations) if torchrun.restarts() else None
    if newest:
        print(f"Restarted by torchrun: resuming {newest}")
    return newest or start


def newest_checkpoint(folder: str, below: float = float("inf"), since: float | None = None) -> str | None:
    """Return the newest whole checkpoint of an iteration under `below`; of equally new ones, that of the highest.

    since: earliest time of writing, in seconds since 1970. None: the time at which torchrun began, so that the
        checkpoint is of torchrun's processes, over all restarts, and not of an earlier training in the folder.
    """
    began = time.time() - (seconds_since_start(os.getppid()) or float("inf")) if since is None else since
    found = {}
    for path in Path(folder).glob("chkpnt*.pth"):
        match = _CHECKPOINT.fullmatch(path.name)
        if match and is_zipfile(path) and (number := int(match[1] or 0)) < below:
            written = path.stat()
            if written.st_mtime >= began:
                found[written.st_mtime_ns, number] = path
    return str(found[max(found)]) if found else None


def refuse_other_scene(dataset: argparse.Namespace, checkpoint: str | None) -> None:
    """Refuse a folder with a model of another scene (UserError), unless the checkpoint to resume lies in it.

    dataset: the model options.
    """
    if not dataset.model_path:
        return
    folder = Path(dataset.model_path)
    trained_on = str(_read_options(folder).get("source_path", ""))
    if not lies_in(checkpoint, folder) and saves_in(folder) and other_scene(trained_on, dataset.source_path):
        raise UserError(
            f"{folder} holds a model of another scene, {trained_on}; name another folder with -m, or remove that one"
        )


def check_folder(
    now: argparse.Namespace,
    saving_iterations: Sequence[int],
    checkpoint: str | None,
    first_iteration: int,
    checkpoint_iterations: Sequence[int] = (),
) -> None:
    """Refuse a folder with saves that this training's options do not fit (UserError).

    Warn of iterations that an earlier training has saved and this one does not overwrite. Programs that read these
    saves take the options of the folder, which are those of the last training.

    now: all options.
    """
    folder = Path(now.model_path)
    saved, then = saves_in(folder), _read_options(folder)
    new = {".ply": saving_iterations, ".pth": (*saving_iterations, *checkpoint_iterations)}
    stay = [n for n, path in saved.items() if n > first_iteration and n not in new[path.suffix]]
    if not stay:
        return
    kept = f"{folder} keeps iteration {', '.join(map(str, sorted(stay)))} of an earlier training"
    changed = [name for name in _list_changed(then, now) if name in VIEW_OPTIONS]
    if changed and max(stay) > max(saving_iterations, default=0):
        before, after = (" ".join(_format_option(n, of[n]) for n in changed) for of in (then, vars(now)))
        raise UserError(
            f"{kept} with {before}, and this one has {after}; name another folder by -m, or remove the old one"
        )
    over = "" if lies_in(checkpoint, folder) else "; this one starts over"
    if over and (replaced := sorted(saved.keys() - {*stay})):
        over += f" and replaces iteration {', '.join(map(str, replaced))}"
    _warn(
        f"{kept}{over}, and other commands take the highest unless --iteration is given; remove the old ones, or "
        "name another folder by -m"
    )


def lies_in(checkpoint: str | None, folder: str | os.PathLike) -> bool:
    """Tell whether there is a checkpoint that lies in a model folder."""
    return checkpoint is not None and _same_place(Path(checkpoint).parent, folder)


def report_changes(checkpoint: str, now: argparse.Namespace, grown: bool = False) -> None:
    """Warn if the run that wrote a checkpoint had other options than this run, `now`.

    Options that the checkpoint's folder does not record are not compared. UserError for another scene, for --eval after
    a training on all photos, and for an option that no longer exists.

    now: all options.
    grown: true if the scene is the same, with more photos.
    """
    folder = Path(checkpoint).parent
    then = _read_options(folder)
    trained_on = str(then.get("source_path", ""))
    if not grown and other_scene(trained_on, now.source_path):
        raise UserError(
            f"{checkpoint} is of another scene, {trained_on}; resume it with that one, or start from its model with "
            "--init_ply"
        )
    gone = {name: value for name, value in then.items() if name not in {option.name for option in OPTIONS}}
    # Views that were smaller at first; a schedule.json keeps their sizes.
    if not (folder / SCHEDULE).is_file() and read_model_json(folder).get("resolution_schedule") == "pyramid":
        gone["resolution_schedule"] = "pyramid"
    if gone:
        raise UserError(
            f"{checkpoint} was trained with {_format_option(*min(gone.items()))}, which this code does not have; use "
            "the code that wrote it, or start a new training from its PLY by --init_ply"
        )
    changed = _list_changed(then, now)
    if "eval" in changed and now.eval:
        raise UserError(
            f"{checkpoint} was trained on all photos, so --eval has no unseen photos to hold out; leave --eval out, or "
            "start a new training"
        )
    if "holdout" in changed and now.eval:
        raise UserError(
            f"{checkpoint} was trained with {_format_option('holdout', then['holdout'])}, so it has seen photos that "
            f"{_format_option('holdout', now.holdout)} holds out; give the former, or start a new training"
        )
    if changed:
        before, after = (" ".join(_format_option(n, of[n]) for n in changed) for of in (then, vars(now)))
        mixed = VIEW_OPTIONS.intersection(changed) and (folder / CURVE).exists()
        of_curve = "; the earlier points of its curve are of those other views" if mixed else ""
        _warn(f"{folder} was trained with {before}, this run has {after}{of_curve}")


def continue_records(model_path: str, checkpoint: str | None, first_iteration: int) -> tuple[TrainingLog, list[Row]]:
    """Return the log of a training and the rows of its curve up to `first_iteration`; both empty for a new training.

    Both are read from the checkpoint's folder if that has a log, else from model_path. This run continues them in
    model_path.
    """
    before = Path(model_path)
    if checkpoint and (Path(checkpoint).parent / training_log.NAME).is_file():
        before = Path(checkpoint).parent
    log, rows = TrainingLog(model_path, first_iteration, before), continue_curve(model_path, first_iteration, before)
    if rows:  # the log may be lost, or end before them
        log.not_before(rows[-1])
    elif checkpoint and not log.records:
        print(
            f"{training_log.NAME} beside {checkpoint} has no records up to iteration {first_iteration}; the seconds of "
            "this run start at 0 there",
            file=sys.stderr,
        )
    return log, rows


def strategy_of(checkpoint: str) -> str:
    """Return the strategy of the run that wrote a checkpoint; adc if its folder does not say."""
    return str(_read_options(Path(checkpoint).parent).get("strategy", "adc"))


def resolve_lenses(dataset: argparse.Namespace, checkpoint: str | None) -> argparse.Namespace:
    """Return model options with --lenses auto replaced: by native, or by the value of the run that wrote a checkpoint.

    A folder that records no value is of a time when photos were undistorted; auto then stays, and means the same.
    UserError for other photos than those of that run.
    """
    given, then = getattr(dataset, "lenses", None), _read_options(Path(checkpoint).parent) if checkpoint else {}
    before = then.get("lenses", "auto") if checkpoint else "native"
    if given == "auto":
        dataset = copy.copy(dataset)
        dataset.lenses = before
    elif given and then and given != before and "native" in (given, before):
        photos = "the photos as they are" if before == "native" else "undistorted photos"
        raise UserError(f"{checkpoint} was trained on {photos}; leave --lenses {given} out")
    return dataset


def enlargement_of(checkpoint: str | None, otherwise: float) -> float:
    """Return the enlargement of the run that wrote a checkpoint.

    otherwise: result without a checkpoint, or if its folder has no model.json.
    """
    record = read_model_json(Path(checkpoint).parent) if checkpoint else {}
    return record.get(ENLARGEMENT, 1.0) if record else otherwise


def _read_options(folder: Path) -> dict[str, object]:
    """Return the training options that a folder records; none if they cannot be read, as without a model."""
    with contextlib.suppress(UserError, OSError):
        return read_training_options(folder)
    return {}


def _list_changed(then: dict[str, object], now: argparse.Namespace) -> list[str]:
    """Return the names of options that differ from those that an earlier training has recorded."""
    names = [option.name for option in OPTIONS if option.compared and option.name in then]
    return [name for name in names if not _equal(name, then[name], getattr(now, name))]


def _equal(name: str, then: object, now: object) -> bool:
    return _same_place(then, now) if name == "source_path" else then == now


def _same_place(one: str | os.PathLike, other: str | os.PathLike) -> bool:
    return os.path.realpath(one) == os.path.realpath(other)


def _format_option(name: str, value: object) -> str:
    """Format an option as it is typed on a command line."""
    if isinstance(value, bool):
        return f"--{name}" if value else f"no --{name}"
    return f"--{name} {value if value != '' else repr(value)}"


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)
