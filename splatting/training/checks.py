"""Checks made before training, so that a hopeless one fails at once: of the scene, and of traces of earlier runs."""

import argparse
import contextlib
import copy
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from arguments import OPTIONS, VIEW_OPTIONS, other_scene, read_training_options
from scene.check import of_options, tell
from scene.check.photos import hints
from scene.gaussians import density_rules as rules
from scene.saved_model import saves_in
from scene.scene import Scene
from splatting.evaluation import training_log
from splatting.evaluation.error_curve import NAME as CURVE
from splatting.evaluation.error_curve import Row, continue_curve
from splatting.evaluation.training_log import TrainingLog
from splatting.files.listing import some
from splatting.parts import part_class, strategies, tools
from splatting.training.density import DensityControl
from splatting.training.schedule import USUAL
from utils.system_utils import UserError

# Milliseconds of a step at 1600x1060 on an H100: of any, and of a million Gaussians (docs/results/several_gpus.md).
STEP_ALONE, STEP_SHARED = (0.9, 1.25), (2.8, 0.87)


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def check_scene(scene: Scene, options: argparse.Namespace, resumed: bool) -> None:
    """Refuse a scene that cannot be trained (UserError), warn of its faults, and say where its frame is moved.

    A resumed training goes on with what its start was told of.
    """
    info, views = scene.info, scene.getTrainCameras()
    if not resumed:
        smallest = min((view.image_width, view.image_height) for view in views)
        found = [*of_options(info, options, scene.halves), *hints(info, smallest, options.white_background)]
        tell(found, options.source_path)
    if info.offset.any():
        print(
            f"the scene's coordinates are large against its extent: training subtracts {tuple(info.offset.tolist())}, "
            "which model.json keeps; python -m scene.export_world writes the model in the scene's own coordinates"
        )


def check_alone(projection: str, several: bool) -> None:
    """Refuse rays of a training of several processes (UserError)."""
    if several and projection == "ray":
        raise UserError(
            "--projection ray needs a training of one process; leave it out, or start train.py without torchrun"
        )


def faster_alone(ranks: int, on_gpu: bool, count: int) -> str | None:
    """What to say if one GPU would train `count` Gaussians, as many as there may be, faster than several do."""
    alone, shared = (base + each * count / 1e6 for base, each in (STEP_ALONE, STEP_SHARED))
    if ranks == 1 or not on_gpu or shared < alone:
        return None
    return (
        f"one GPU is faster here: a step of {count:,} Gaussians takes it about {alone:.1f} ms, and two that share it "
        f"{shared:.1f} ms; start train.py without torchrun, unless they do not fit"
    )


def without_effect(opt: argparse.Namespace, strategy: str) -> str | None:
    """What to say of given options that belong to another strategy."""
    others = [option for name in strategies() if name != strategy for option in part_class(name).options.optimisation]
    given = [f"--{option.name}" for option in others if getattr(opt, option.name) != option.default]
    return f"--strategy {strategy} has no use for {some(given)}" if given else None


def late_reset(density: DensityControl, opt: argparse.Namespace, done: int) -> str | None:
    """What to say if a strategy resets opacities so late that the model cannot recover.

    done: iterations before this run, which may have been the reset. A run with a time budget leaves such resets out.
    """
    schedule = density.schedule
    if schedule.paced:
        return None
    last = range(max(done, schedule.ends - rules.RECOVERY) + 1, schedule.ends)
    if not (due := [iteration for iteration in last if density.resets(iteration)]):
        return None
    of_white = schedule.schedule_step(due[-1]) % opt.opacity_reset_interval > 0
    remedy = "raise --opacity_reset_interval"
    if of_white:
        remedy = "lower --densify_from_iter, where a white background has a reset"
    return (
        f"opacities are reset in iteration {due[-1]}, and {schedule.ends - due[-1]} iterations are too few to recover "
        f"from that; {remedy}"
    )


def another_number(density: DensityControl, opt: argparse.Namespace, count: int, first: int) -> str | None:
    """What to say if a strategy cannot reach its number of Gaussians in time.

    count: of Gaussians, now; first: the next iteration. Not known of a run with a time budget.
    """
    schedule, aim, strategy = density.schedule, density.most_gaussians, part_class(opt.strategy)
    if schedule.paced or schedule.schedule_step(first) >= density.ends > 0:
        return None  # what is repeated or resumed has no say in it any more
    ending, start = strategy.until[0], f"--densify_from_iter {opt.densify_from_iter} is not before"
    if 0 < density.ends <= opt.densify_from_iter < schedule.length:
        return f"{start} --{ending} {density.ends}, so no Gaussians are added; lower --densify_from_iter"
    reached = density.most_after(count, first, schedule.ends)
    too_many, too_late = 0 < opt.max_num_splats < count, opt.densify_from_iter >= schedule.length
    remover = next((name for name in strategies() if part_class(name).removes), None)
    if not density.grows_to:
        remedy = f"; --strategy {remover} gets down to it" if remover and not too_late else ""
        adds = f"{opt.strategy} adds none, and removes only faint ones"
        return f"{_start_of(count, opt)}; {adds}{remedy}" if too_many else None
    if reached == aim or ((reached > aim or density.default_is_limit) and not opt.max_num_splats):
        return None
    done = schedule.schedule_step(first) - 1
    # Half of what is left suits rules that need the rest to settle, as those that end late by default do not.
    ends = f"--{ending} {done + (schedule.length - done) // 2}" if strategy.until[1] == 1 / 2 else ""
    scaled = None
    if not done and opt.densify_from_iter < density.ends < USUAL:
        scaled = next((remedy(schedule.length) for remedy in tools("for_few_iterations")), None)
    if too_late:
        window = f"--densify_from_iter {done + (schedule.length - done) // 20} {ends}".rstrip()
        why = f"{start} the end; give {scaled or window}"
        if too_many and strategy.removes:
            return f"{_start_of(count, opt)}; only faint ones are removed, as {why}"
    elif too_many and not strategy.removes:
        why = f"it removes none; --strategy {remover} does"
    elif ends and schedule.length < density.ends:
        why = f"--{ending} {density.ends} is not before the end; give {scaled or ends}"
    else:
        why = density.too_slow()
    return f"--strategy {opt.strategy} gets to {reached:,} Gaussians, not to {aim:,}, as {why}"


def _start_of(count: int, opt: argparse.Namespace) -> str:
    return f"the start has {count:,} Gaussians, more than --max_num_splats {opt.max_num_splats}"


def check_folder(
    now: argparse.Namespace,
    saving_iterations: Sequence[int],
    checkpoint: str | None,
    first_iteration: int,
    checkpoint_iterations: Sequence[int] = (),
) -> None:
    """Refuse a folder with a model of another scene (UserError), or with one that this training's options do not fit.

    now: all options. Warn of iterations that an earlier training has saved and this one does not overwrite. Programs
    that read them take the folder's options, which are those of the last training.
    """
    folder = Path(now.model_path)
    saved, then = saves_in(folder), _options_of(folder)
    trained_on = str(then.get("source_path", ""))
    if not lies_in(checkpoint, folder) and saved and other_scene(trained_on, now.source_path):
        raise UserError(
            f"{folder} holds a model of another scene, {trained_on}; name another folder with -m, or remove that one"
        )
    new = {".ply": saving_iterations, ".pth": (*saving_iterations, *checkpoint_iterations)}
    stay = [n for n, path in saved.items() if n > first_iteration and n not in new[path.suffix]]
    if not stay:
        return
    kept = f"{folder} keeps iteration {', '.join(map(str, sorted(stay)))} of an earlier training"
    changed = [name for name in _changed(then, now) if name in VIEW_OPTIONS]
    if changed and max(stay) > max(saving_iterations, default=0):
        before, after = (" ".join(_typed(n, of[n]) for n in changed) for of in (then, vars(now)))
        raise UserError(
            f"{kept} with {before}, which {after} would not fit; name another folder by -m, or remove the old one"
        )
    over = "" if lies_in(checkpoint, folder) else "; this one starts over"
    if over and (replaced := sorted(saved.keys() - {*stay})):
        over += f" and replaces iteration {', '.join(map(str, replaced))}"
    _warn(
        f"{kept}{over}, and other commands take the highest unless --iteration is given; remove the old ones, or "
        "name another folder by -m"
    )


def lies_in(checkpoint: str | None, folder: str | os.PathLike) -> bool:
    """Whether a checkpoint, if there is one, lies in a model folder."""
    return checkpoint is not None and _same_place(Path(checkpoint).parent, folder)


def report_changes(checkpoint: str, now: argparse.Namespace) -> None:
    """Warn if the run that wrote a checkpoint had other options than this run, `now`.

    now: all options. Those that the checkpoint's folder does not record are not compared. UserError for another scene,
    and for --eval after a training on all photos.
    """
    folder = Path(checkpoint).parent
    then = _options_of(folder)
    trained_on = str(then.get("source_path", ""))
    if other_scene(trained_on, now.source_path):
        raise UserError(
            f"{checkpoint} is of another scene, {trained_on}; resume it with that one, or start from its model with "
            "--init_ply"
        )
    changed = _changed(then, now)
    if "eval" in changed and now.eval:
        raise UserError(
            f"{checkpoint} was trained on all photos, so --eval can hold out none that it has not seen; leave --eval "
            "out, or start a new training"
        )
    if changed:
        before, after = (" ".join(_typed(n, of[n]) for n in changed) for of in (then, vars(now)))
        mixed = VIEW_OPTIONS.intersection(changed) and (folder / CURVE).exists()
        of_curve = "; the earlier points of its curve are of those other views" if mixed else ""
        _warn(f"{folder} was trained with {before}, this run has {after}{of_curve}")


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
            f"{training_log.NAME} beside {checkpoint} is missing, or has nothing up to iteration {first_iteration}: "
            "seconds count from there, in the curve too",
            file=sys.stderr,
        )
    return log, rows


def strategy_of(checkpoint: str) -> str:
    """The strategy of the run that wrote a checkpoint; adc if its folder does not say."""
    return str(_options_of(Path(checkpoint).parent).get("strategy", "adc"))


def with_lenses(dataset: argparse.Namespace, checkpoint: str | None) -> argparse.Namespace:
    """Model options whose --lenses auto is decided: native, or that of the run that wrote a checkpoint to resume.

    A folder that does not say was written when photos were undistorted, as they are where auto stays. UserError for
    other photos than those of that run.
    """
    given, then = getattr(dataset, "lenses", None), _options_of(Path(checkpoint).parent) if checkpoint else {}
    before = then.get("lenses", "auto") if checkpoint else "native"
    if given == "auto":
        dataset = copy.copy(dataset)
        dataset.lenses = before
    elif given and then and given != before and "native" in (given, before):
        photos = "the photos as they are" if before == "native" else "undistorted photos"
        raise UserError(f"{checkpoint} was trained on {photos}; leave --lenses {given} out")
    return dataset


def _options_of(folder: Path) -> dict[str, object]:
    """Training options that a folder records; none if they cannot be read, as in a folder without a model."""
    with contextlib.suppress(UserError, OSError):
        return read_training_options(folder)
    return {}


def _changed(then: dict[str, object], now: argparse.Namespace) -> list[str]:
    """Names of options that differ from those of an earlier training, as far as that recorded them."""
    names = [option.name for option in OPTIONS if option.compared and option.name in then]
    return [name for name in names if not _equal(name, then[name], getattr(now, name))]


def _equal(name: str, then: object, now: object) -> bool:
    return _same_place(then, now) if name == "source_path" else then == now


def _same_place(one: str | os.PathLike, other: str | os.PathLike) -> bool:
    return os.path.realpath(one) == os.path.realpath(other)


def _typed(name: str, value: object) -> str:
    """Format an option as it is typed on a command line."""
    if isinstance(value, bool):
        return f"--{name}" if value else f"no --{name}"
    return f"--{name} {value if value != '' else repr(value)}"
