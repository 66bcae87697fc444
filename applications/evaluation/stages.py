"""The stages train, render, score and page. Each is a subprocess, and is skipped silently if it is finished.

child: `run_child`, or what stands in for it.
"""

from __future__ import annotations

import math
import re
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from applications.evaluation.child import Finished
from applications.evaluation.plan import Record, Run
from splatting.records.model_folder import load_scores, logged, trained_iterations
from splatting.records.renders import TIMES, ground_truth_digest, view_names
from utils.lpips_utils import TOLD
from utils.system_utils import UserError, mkdir_p, saved_ply

_ROOT = Path(__file__).resolve().parents[2]
Child = Callable[..., Finished]


@dataclass(frozen=True)
class Failure:
    """A stage that failed: its name, its command line (empty if nothing was started), its last messages."""

    stage: str
    command: list[str]
    lines: list[str]


class StageFailed(Exception):
    """Ends a run's remaining stages; carries the Failure."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.lines[-1] if failure.lines else failure.stage)
        self.failure = failure


def _read_source(run: Run) -> str:
    if (source := run.scene.source) is None or not source.is_dir():
        reason = f"no such scene folder: {source}" if source else f"no scene folder was given for {run.scene.name}"
        raise StageFailed(Failure("train", [], [reason]))
    return str(source)


def train(run: Run, machine: dict[str, Any], child: Child) -> None:
    """Train, unless the training is finished. Resume only from a checkpoint that an interrupt left.

    A checkpoint of a training that failed may hold half a densification, and would fail again with the same options, so
    training then starts from the beginning. `plan.check_folders` has made sure that nothing in the model folder was
    made with other options.
    """
    source, record = _read_source(run), Record(run.model)
    if _is_trained(run, record):
        return
    record.start(run.key)
    there = _list_checkpoints(run)
    before = record.stage("train_interrupted") or {}
    before = before if before.get("checkpoint") in there else {}
    command = _make_command("train.py", "-s", source, "-m", str(run.model), "--disable_viewer", "--quiet")
    command += ["--no_last_checkpoint", *run.options]
    command += ("--start_checkpoint", str(run.model / before["checkpoint"])) if before else ()
    done = child(command, "training" + _describe_start(before, record))
    spent = _sum_seconds(before, done)
    if done.status and (left := [name for name, stamp in _list_checkpoints(run).items() if stamp != there.get(name)]):
        stopped = done.interrupt and done.status in (128 + signal.SIGINT, 128 + signal.SIGTERM)
        latest = max(left, key=_parse_iteration)
        stops = {"stops": [*before.get("stops", []), _parse_iteration(latest)]} if stopped else {}
        record.note("train_interrupted" if stopped else "train_failed", checkpoint=latest, **stops, **spent)
    _require_success("train", command, done)
    for stop in before.get("stops", ()):
        _remove_stop(run, stop)
    iterations = trained_iterations(run.model)
    if (run.iterations or max(logged(run.model), default=None)) not in iterations:
        raise StageFailed(Failure("train", command, [f"train.py succeeded, but {run.model} lacks the last iteration"]))
    record.note("train", iterations=iterations, machine=machine, **spent)
    _stop_if_asked(done)


def _remove_stop(run: Run, iteration: int) -> None:
    """Remove what an interrupt has saved, unless that iteration was asked for, too."""
    if isinstance(iteration, int) and str(iteration) not in run.options:  # not what a damaged record has
        shutil.rmtree(saved_ply(run.model, iteration).parent, ignore_errors=True)
        (run.model / f"chkpnt{iteration}.pth").unlink(missing_ok=True)


def _sum_seconds(before: dict[str, Any], done: Finished) -> dict[str, float | None]:
    """Return the seconds of a training with those of its parts before; CPU seconds None if not known."""
    parts = {
        name: (before.get(name) if before else 0.0, getattr(done, name)) for name in ("wall_seconds", "cpu_seconds")
    }
    return {name: None if None in both else round(sum(both), 3) for name, both in parts.items()}


def _is_trained(run: Run, record: Record) -> bool:
    done = record.stage("train")
    if not done or run.iterations not in (None, *done["iterations"]):
        return False
    return all(saved_ply(run.model, iteration).is_file() for iteration in done["iterations"])


def _list_checkpoints(run: Run) -> dict[str, list[int]]:
    """Return the names of checkpoints in the model folder before the last iteration, each with its `_read_stamp`."""
    found = [path for path in run.model.glob("chkpnt*.pth") if re.fullmatch(r"\d+", path.stem[6:]) and path.is_file()]
    return {
        path.name: _read_stamp(path) for path in found if _parse_iteration(path.name) < (run.iterations or math.inf)
    }


def _parse_iteration(checkpoint: str) -> int:
    return int(checkpoint[6:-4])


def _describe_start(before: dict[str, Any], record: Record) -> str:
    """Return where a training starts, if not from nothing on: at a checkpoint, or anew after a failure.

    before: the part of this training that was interrupted, {} without one.
    """
    if before:
        return f" from {before['checkpoint']}"
    if failed := record.stage("train_failed"):
        return (
            f" from the start ({failed['checkpoint']} was left by a training that failed after "
            f"{failed['wall_seconds']:.0f} s)"
        )
    return ""


def _list_saved(run: Run, stage: str) -> list[int]:
    if iterations := trained_iterations(run.model):
        return iterations
    raise StageFailed(Failure(stage, [], [f"{run.model} has no saved iteration; train it first"]))


def _make_source_words(run: Run) -> tuple[str, ...]:
    """Return the option -s with the folder of the scene, if that is known."""
    return ("-s", str(run.scene.source)) if run.scene.source else ()


def _run_once(
    child: Child, record: Record, name: str, say: str, command: list[str], requested: dict[str, Any],
    found: Callable[[], dict[str, Any] | None], also: Callable[[], dict[str, Any]] = dict, **environment: str,
) -> None:  # fmt: skip
    """Run a command, unless its stage is noted as done with what is requested and what is found.

    found: tells of the stage's files, None where they are missing; also: what is noted besides.
    """
    noted, there = record.stage(name), found()
    if noted and there is not None and {key: noted.get(key) for key in requested | there} == requested | there:
        return
    done, stage = child(command, say, **environment), name.partition("_")[0]
    _require_success(stage, command, done)
    there = found()
    if there is None:
        raise StageFailed(Failure(stage, command, ["the scene has no test views, so there is nothing to score"]))
    record.note(name, **requested, **there, **also(), wall_seconds=round(done.wall_seconds, 3))
    _stop_if_asked(done)


def render(run: Run, options: Sequence[str], child: Child) -> None:
    """Render the test views of every saved iteration, except those already rendered from the same model.

    options: more words for render.py.
    """
    for iteration in _list_saved(run, "render"):
        command = _make_command(
            "render.py", "-m", str(run.model), *_make_source_words(run), "--iteration", str(iteration)
        )
        command += ["--skip_train", "--eval", "--quiet", *options]
        requested = {"model": _read_stamp(saved_ply(run.model, iteration)), "options": list(options)}
        say, found = f"rendering iteration {iteration}", partial(_count_rendered, run.model, iteration)
        _run_once(child, Record(run.model), f"render_{iteration}", say, command, requested, found)


def _read_stamp(file: Path) -> list[int]:
    """Return size and time of a file, to tell whether it changed without reading it."""
    state = file.stat()
    return [state.st_size, state.st_mtime_ns]


def _count_rendered(model: Path, iteration: int) -> dict[str, int] | None:
    """Return the number of rendered `views`; None if there are none, or a render or a ground truth is missing."""
    folder = model / "test" / f"ours_{iteration}"
    renders, truth = view_names(folder / "renders"), view_names(folder / "gt")
    return {"views": len(renders)} if renders and renders == truth else None


def score(run: Run, child: Child, download: bool = True, weights: Path | None = None, stlpips: bool = False) -> bool:
    """Run metrics.py, unless the same renders are already scored, with the same folder of weights and ST-LPIPS or not.

    download: whether it may try to download the weights of LPIPS; return whether another run may. A try without an
    answer takes 10 seconds.
    """
    record, model = Record(run.model), run.model
    methods = [f"ours_{iteration}" for iteration in trained_iterations(model) if _count_rendered(model, iteration)]
    if not methods:
        raise StageFailed(Failure("metrics", [], [f"{model} has no rendered test views; render them first"]))
    times = {method: model / "test" / method / TIMES for method in methods}  # render.py writes these last
    renders = {method: _read_stamp(path) if path.is_file() else None for method, path in times.items()}
    if None in renders.values() or not _is_scored(model, methods):
        record.forget("metrics")
    before = record.stage("metrics")
    environment = {} if download else {"GS_DOWNLOAD": TOLD}
    given = {} if weights is None else {"weights": str(weights.resolve())}
    words = [f"--{name}={folder}" for name, folder in given.items()] + ["--stlpips"] * stlpips
    given |= {"stlpips": True} if stlpips else {}
    command = _make_command("metrics.py", "-m", str(model), "--error_maps", *words)
    _run_once(
        child, record, "metrics", "scoring", command, {"renders": renders, **given}, dict,
        lambda: {"ground_truth_sha256": ground_truth_digest(model / "test" / methods[-1])}, **environment,
    )  # fmt: skip
    if record.stage("metrics") is before:
        return download
    return download and load_scores(model, methods[-1])[0].get("LPIPS") is not None


def page_file(model: Path, output: Path) -> Path:
    """Return the path of a model's HTML file, beside the report in the folder `output`."""
    return output / "models" / f"{model.relative_to(output)}.html"


def write_page(run: Run, output: Path, options: Sequence[str], child: Child) -> None:
    """Write the last saved iteration as one HTML file, unless it was made of the same model.

    options: more words for export.py.
    """
    last, file = _list_saved(run, "html")[-1], page_file(run.model, output)
    mkdir_p(file.parent)
    command = _make_command("export.py", "-m", str(run.model), *_make_source_words(run), "--iteration", str(last))
    command += ["--to", str(file), "--raw", *options]  # what was scored
    requested = {"model": _read_stamp(saved_ply(run.model, last)), "options": list(options)}
    say = "writing the model as a page"
    _run_once(child, Record(run.model), "html", say, command, requested, lambda: {} if file.is_file() else None)


def _is_scored(model: Path, methods: Sequence[str]) -> bool:
    try:
        return all(load_scores(model, method) for method in methods)
    except UserError:
        return False


def _make_command(name: str, *words: str) -> list[str]:
    """Return the command that runs a script of the repository. words: its arguments."""
    return [sys.executable, str(_ROOT / name), *words]


def _require_success(stage: str, command: list[str], done: Finished) -> None:
    if not done.status:
        return
    _stop_if_asked(done)
    raise StageFailed(Failure(stage, command, done.lines))


def _stop_if_asked(done: Finished) -> None:
    if done.interrupt:
        raise done.interrupt
