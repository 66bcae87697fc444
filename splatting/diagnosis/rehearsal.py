"""Rehearsal of full_eval.py: whether its runs would find what they need, and about how long they would take."""

import argparse
import contextlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from splatting.evaluation import stages
from splatting.evaluation.plan import RECORD, Record, Run
from splatting.files.listing import markdown_table
from utils.system_utils import UserError

_SAME = ("cpu", "gpu", "threads")  # facts of a machine that decide about seconds
_DEPTHS = ("*", "*/*", "*/*/*")  # of model folders in the output folder
Parse = Callable[[Sequence[str]], tuple[argparse.Namespace, ...]]


class _Finished(NamedTuple):
    """A finished training: its key (Run.key), seconds of train.py, seconds of rendering and scoring, iterations."""

    key: dict[str, Any]
    training: float
    rest: float
    iterations: int


def rehearse(runs: Sequence[Run], output: Path, parse: Parse, machine: dict[str, Any], trains: bool = True) -> None:
    """Print what each run would be and how long all would take here; nothing is written into the output folder.

    parse: train.py's parser. machine: facts of this one. trains: False if existing models are rendered and scored.
    UserError for a scene or an option that would fail.
    """
    known, rows, total, timed = _finished(output, machine), [], 0.0, {}
    photos: dict[str, tuple[str, str]] = {}
    for run in runs:
        _, dataset, opt, _ = parse([*run.options, "-s", str(run.scene.source or "")])
        key = str(vars(dataset))
        photos[key] = photos.get(key) or _photos(dataset, run)
        state, about, by = stages.state(run, trains), 0.0, "-"
        if state != stages.FINISHED:
            about, by = _like(run, known, state, opt)
        if about is None and trains:
            timed[key] = timed.get(key) or stages.timed_piece(run)
            about, by = opt.time_budget or timed[key][0] + timed[key][1] * opt.iterations, "a timed piece"
        total += about or 0.0
        seed, spent = "-" if run.seed is None else str(run.seed), _duration(about) if about else "-"
        end = "-" if not trains else f"{run.iterations:,}" if run.iterations else "by itself"
        rows.append([run.scene.name, run.config or "-", seed, *photos[key], end, state, spent, by])
    header = ["scene", "options", "seed", "photos: train, test", "size", "iterations", "state", "about", "by"]
    print(markdown_table(header, rows))
    print(_remark(total, bool(timed)))


def _photos(dataset: argparse.Namespace, run: Run) -> tuple[str, str]:
    """Numbers of photos and their sizes in training, found as training finds them. UserError as from Scene."""
    if run.scene.source is None:
        return "-", "-"
    if dataset.lenses == "auto":
        dataset.lenses = "native"
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # from the readers
            scene = Scene(dataset, GaussianModel(0), shuffle=False, start=False)
    except UserError as error:
        raise UserError(f"{run.title}: {error}") from error
    train, test = scene.getTrainCameras(), scene.getTestCameras()
    if not test:
        raise UserError(f"{run.title}: the scene has no test views, so there is nothing to score; add test photos")
    sizes = sorted({(camera.image_width, camera.image_height) for camera in (*train, *test)})
    many = f" and {len(sizes) - 1} more" if len(sizes) > 1 else ""
    return f"{len(train)}, {len(test)}", f"{sizes[-1][0]}x{sizes[-1][1]}{many}"


def _finished(output: Path, machine: dict[str, Any]) -> list[_Finished]:
    """List the trainings in the output folder that finished on a machine like this one."""
    found = []
    for path in (path for depth in _DEPTHS for path in sorted(output.glob(f"{depth}/{RECORD}"))):
        record = Record(path.parent)
        train = record.stage("train")
        if train and record.key and all(train["machine"].get(name) == machine.get(name) for name in _SAME):
            rest = sum(record.stage(name)["wall_seconds"] for name in record.names() if name.startswith(stages.REST))
            found.append(_Finished(record.key, train["wall_seconds"], rest, max(train["iterations"])))
    return found


def _like(run: Run, known: Sequence[_Finished], state: str, opt: argparse.Namespace) -> tuple[float | None, str]:
    """Seconds of a run by the finished ones that are most like it, and which these are; None if there are none.

    Those of the same scene and options but for the seed come first, then those of the scene, then the others, by their
    seconds an iteration.
    """
    likeness = [(one.key["scene"] == run.key["scene"], _unseeded(one.key["options"]) == _unseeded(run.options))
                for one in known]  # fmt: skip
    if not likeness:
        return None, "-"
    best = max(likeness)
    alike = [one for one, how in zip(known, likeness, strict=True) if how == best]
    seconds = fmean(one.rest for one in alike)
    if state != stages.TO_SCORE:
        same, end = fmean(one.training for one in alike), opt.time_budget
        pace = fmean(one.training / one.iterations for one in alike)
        seconds += same if all(best) else end or opt.iterations * pace
    return seconds, "other seeds" if all(best) else "this scene" if best[0] else "other scenes"


def _unseeded(options: Sequence[str]) -> list[str]:
    words = list(options)
    if "--seed" in words:
        at = words.index("--seed")
        del words[at : at + 2]
    return words


def _remark(seconds: float, timed: bool) -> str:
    if not seconds:
        return "nothing is left to do, or nothing tells how long it would take"
    if not timed:
        return f"about {_duration(seconds)} in all, by trainings in the output folder that finished on this machine"
    return (
        f"at least {_duration(seconds)} in all; pieces of {stages.PIECE} iterations were timed now: later ones take "
        "longer, as Gaussians become more, and advice, rendering and scoring come on top"
    )


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
