"""The stages train, render, score and page. Each is a subprocess, and is skipped silently if it is finished."""

from __future__ import annotations

import math
import re
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evaluation.child import Finished, run_child
from evaluation.model_folder import ground_truth_digest, load_scores, logged, ply_file, trained_iterations, view_names
from evaluation.record import Record
from evaluation.runs import Run
from records import render_times
from utils.system_utils import UserError, mkdir_p

_ROOT = Path(__file__).resolve().parents[1]


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


def train(run: Run, machine: dict[str, Any]) -> None:
    """Train, unless the training is finished. Resume only from a checkpoint that an interrupt left.

    A checkpoint of a training that failed may hold half a densification, and would fail again with the same options, so
    training then starts from the beginning. `runs.check_folders` has made sure that nothing in the model folder was
    made with other options.
    """
    if run.scene.source is None:
        raise StageFailed(Failure("train", [], [f"no scene folder was given for {run.scene.name}"]))
    if not run.scene.source.is_dir():
        raise StageFailed(Failure("train", [], [f"no such scene folder: {run.scene.source}"]))
    record = Record(run.model)
    if _trained(run, record):
        return
    record.start(run.key)
    interrupted = _interrupted(run, record)
    checkpoint = interrupted and run.model / interrupted["checkpoint"]
    before = _spent(interrupted)
    resume = ("--start_checkpoint", str(checkpoint)) if checkpoint else ()
    command = _script("train.py", "-s", str(run.scene.source), "-m", str(run.model), "--disable_viewer", "--quiet")
    command += [*run.options, *resume]
    _say("training" + _from_where(checkpoint, record))
    there = _checkpoints(run)
    done = run_child(command)
    spent = _sum(before, done)
    if done.status:
        left = [path for path, stamp in _checkpoints(run).items() if stamp != there.get(path)]
        if left:
            _note_stop(record, done, max(left, key=_iteration_of), spent)
    _expect_success("train", command, done)
    iterations = trained_iterations(run.model)
    if (run.iterations or max(logged(run.model), default=None)) not in iterations:
        raise StageFailed(Failure("train", command, [f"train.py succeeded, but {run.model} lacks the last iteration"]))
    record.note("train", iterations=iterations, machine=machine, **spent)
    _stop_if_asked(done)


def _spent(interrupted: dict[str, Any] | None) -> dict[str, float | None]:
    """Return the seconds of the parts of a training before it was interrupted; CPU seconds None if not known."""
    if interrupted is None:
        return {"wall_seconds": 0.0, "cpu_seconds": 0.0}
    return {"wall_seconds": interrupted["wall_seconds"], "cpu_seconds": interrupted.get("cpu_seconds")}


def _sum(before: dict[str, float | None], done: Finished) -> dict[str, float | None]:
    cpu = None if None in (before["cpu_seconds"], done.cpu_seconds) else before["cpu_seconds"] + done.cpu_seconds
    wall = before["wall_seconds"] + done.seconds
    return {"wall_seconds": round(wall, 3), "cpu_seconds": None if cpu is None else round(cpu, 3)}


def _trained(run: Run, record: Record) -> bool:
    done = record.stage("train")
    if not done or run.iterations not in (None, *done["iterations"]):
        return False
    return all(ply_file(run.model, iteration).is_file() for iteration in done["iterations"])


def _checkpoints(run: Run) -> dict[Path, list[int]]:
    """Return the checkpoints in the model folder before the last iteration, each with its `_stamp`."""
    found = [path for path in run.model.glob("chkpnt*.pth") if re.fullmatch(r"\d+", path.stem[6:])]
    return {path: _stamp(path) for path in found if _iteration_of(path) < (run.iterations or math.inf)}


def _iteration_of(checkpoint: Path) -> int:
    return int(checkpoint.stem[6:])


def _note_stop(record: Record, done: Finished, checkpoint: Path, spent: dict[str, float | None]) -> None:
    """Note the checkpoint of a training that was stopped or failed, and its seconds including earlier parts."""
    stopped = done.interrupt and done.status in (128 + signal.SIGINT, 128 + signal.SIGTERM)
    record.note("train_interrupted" if stopped else "train_failed", checkpoint=checkpoint.name, **spent)


def _interrupted(run: Run, record: Record) -> dict[str, Any] | None:
    """Return the notes of an interrupt whose checkpoint still exists; None if there are none."""
    noted = record.stage("train_interrupted") or {}
    return noted if noted.get("checkpoint") in [path.name for path in _checkpoints(run)] else None


def _from_where(checkpoint: Path | None, record: Record) -> str:
    if checkpoint:
        return f" from {checkpoint.name}"
    if failed := record.stage("train_failed"):
        return (
            f" from the start ({failed['checkpoint']} was left by a training that failed after "
            f"{failed['wall_seconds']:.0f} s)"
        )
    return ""


def render(run: Run, options: Sequence[str]) -> None:
    """Render the test views of every saved iteration, except those already rendered from the same model.

    options: more words for render.py.
    """
    record = Record(run.model)
    iterations = trained_iterations(run.model)
    if not iterations:
        raise StageFailed(Failure("render", [], [f"{run.model} has no saved iteration; train it first"]))
    source = ("-s", str(run.scene.source)) if run.scene.source else ()
    for iteration in iterations:
        wanted = {"model": _stamp(ply_file(run.model, iteration)), "options": list(options)}
        done = record.stage(f"render_{iteration}")
        if done and {key: done[key] for key in wanted} == wanted and _rendered(run.model, iteration) == done["views"]:
            continue
        command = _script("render.py", "-m", str(run.model), *source, "--iteration", str(iteration), "--skip_train")
        command += ["--eval", "--quiet", *options]
        _say(f"rendering iteration {iteration}")
        finished = run_child(command)
        _expect_success("render", command, finished)
        if not (views := _rendered(run.model, iteration)):
            raise StageFailed(Failure("render", command, ["the scene has no test views, so there is nothing to score"]))
        record.note(f"render_{iteration}", **wanted, views=views, wall_seconds=round(finished.seconds, 3))
        _stop_if_asked(finished)


def _stamp(file: Path) -> list[int]:
    """Return size and time of a file, to tell whether it changed without reading it."""
    state = file.stat()
    return [state.st_size, state.st_mtime_ns]


def _rendered(model: Path, iteration: int) -> int:
    """Return the number of rendered views; 0 if a render or a ground truth is missing."""
    folder = model / "test" / f"ours_{iteration}"
    renders, truth = view_names(folder / "renders"), view_names(folder / "gt")
    return len(renders) if renders == truth else 0


def score(run: Run, download: bool = True) -> bool:
    """Run metrics.py, unless the same renders are already scored.

    download: whether it may try to download the weights of LPIPS; return whether another run may. A try without an
    answer takes 10 seconds.
    """
    record = Record(run.model)
    iterations = trained_iterations(run.model)
    methods = [f"ours_{iteration}" for iteration in iterations if _rendered(run.model, iteration)]
    if not methods:
        raise StageFailed(Failure("metrics", [], [f"{run.model} has no rendered test views; render them first"]))
    renders = {method: _times_stamp(run.model, method) for method in methods}
    done = record.stage("metrics")
    if done and done["renders"] == renders and None not in renders.values() and _scored(run.model, methods):
        return download
    command = _script("metrics.py", "-m", str(run.model))
    _say("scoring")
    finished = run_child(command) if download else run_child(command, GS_DOWNLOAD="0")
    _expect_success("metrics", command, finished)
    truth = ground_truth_digest(run.model, methods[-1])
    record.note("metrics", ground_truth_sha256=truth, renders=renders, wall_seconds=round(finished.seconds, 3))
    _stop_if_asked(finished)
    return download and load_scores(run.model, methods[-1])[0].get("LPIPS") is not None


def page_file(model: Path, output: Path) -> Path:
    """Return the path of a model's HTML file, beside the report in the folder `output`."""
    return output / "models" / f"{model.relative_to(output)}.html"


def page(run: Run, output: Path, options: Sequence[str]) -> None:
    """Write the last saved iteration as one HTML file, unless it was made of the same model.

    options: more words for export.py.
    """
    record = Record(run.model)
    iterations = trained_iterations(run.model)
    if not iterations:
        raise StageFailed(Failure("html", [], [f"{run.model} has no saved iteration; train it first"]))
    file = page_file(run.model, output)
    wanted = {"model": _stamp(ply_file(run.model, iterations[-1])), "options": list(options)}
    done = record.stage("html")
    if done and {key: done[key] for key in wanted} == wanted and file.is_file():
        return
    source = ("-s", str(run.scene.source)) if run.scene.source else ()
    mkdir_p(file.parent)
    last = "--iteration", str(iterations[-1])
    command = _script("export.py", "-m", str(run.model), *source, *last, "--to", str(file), *options)
    _say("writing the model as a page")
    finished = run_child(command)
    _expect_success("html", command, finished)
    record.note("html", **wanted, wall_seconds=round(finished.seconds, 3))
    _stop_if_asked(finished)


def _times_stamp(model: Path, method: str) -> list[int] | None:
    """Return the `_stamp` of the file that render.py writes last, to tell whether renders changed; None without it."""
    times = model / "test" / method / render_times.NAME
    return _stamp(times) if times.is_file() else None


def _scored(model: Path, methods: Sequence[str]) -> bool:
    try:
        for method in methods:
            load_scores(model, method)
    except UserError:
        return False
    return True


def _say(what: str) -> None:
    print(f"  {what}", flush=True)


def _script(name: str, *words: str) -> list[str]:
    return [sys.executable, str(_ROOT / name), *words]


def _expect_success(stage: str, command: list[str], done: Finished) -> None:
    if not done.status:
        return
    _stop_if_asked(done)
    raise StageFailed(
        Failure(stage, command, [*done.lines, done.reason] if done.status < 0 else done.lines or [done.reason])
    )


def _stop_if_asked(done: Finished) -> None:
    if done.interrupt:
        raise done.interrupt
