"""Train, render, score: each a subprocess, each left out, in silence, where it is finished."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evaluation.child import Finished, run_child
from evaluation.model_folder import ground_truth_digest, load_scores, ply_file, view_names
from evaluation.record import Record
from evaluation.runs import Run
from utils.system_utils import UserError, saved_iterations

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Failure:
    """A stage that went wrong: its name, its command line (none where there was nothing to start), what was said."""

    stage: str
    command: list[str]
    lines: list[str]


class StageFailed(Exception):
    """Ends a run's remaining stages; carries the Failure."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.lines[-1] if failure.lines else failure.stage)
        self.failure = failure


def train(run: Run, machine: dict[str, Any]) -> None:
    """Train, unless that is finished; go on from a checkpoint where an interrupted run has left one.

    `runs.check_folders` has seen to it that nothing in the model folder was made with other options.
    """
    if run.scene.source is None:
        raise StageFailed(Failure("train", [], [f"no folder was given for {run.scene.name}"]))
    if not run.scene.source.is_dir():
        raise StageFailed(Failure("train", [], [f"no such scene folder: {run.scene.source}"]))
    record = Record(run.model)
    if _trained(run, record):
        return
    record.start(run.key)
    checkpoint = _last_checkpoint(run)
    before = (record.stage("train_interrupted") or {}).get("wall_seconds", 0.0) if checkpoint else 0.0
    resume = ("--start_checkpoint", str(checkpoint)) if checkpoint else ()
    command = _script("train.py", "-s", str(run.scene.source), "-m", str(run.model), "--disable_viewer", "--quiet")
    command += [*run.options, *resume]
    _say("training" + (f" from {checkpoint.name}" if checkpoint else ""))
    done = run_child(command)
    wall = round(before + done.seconds, 3)
    if done.status and done.interrupt:
        record.note("train_interrupted", wall_seconds=wall)
    _expect_success("train", command, done)
    iterations = saved_iterations(run.model / "point_cloud")
    if run.iterations not in iterations:
        raise StageFailed(Failure("train", command, [f"train.py ended well, yet {run.model} lacks the last iteration"]))
    record.note("train", iterations=iterations, machine=machine, wall_seconds=wall)
    _stop_if_asked(done)


def _trained(run: Run, record: Record) -> bool:
    done = record.stage("train")
    if not done or run.iterations not in done["iterations"]:
        return False
    return all(ply_file(run.model, iteration).is_file() for iteration in done["iterations"])


def _last_checkpoint(run: Run) -> Path | None:
    found = {int(path.stem[6:]): path for path in run.model.glob("chkpnt*.pth") if re.fullmatch(r"\d+", path.stem[6:])}
    usable = [iteration for iteration in found if iteration < (run.iterations or 0)]
    return found[max(usable)] if usable else None


def render(run: Run, options: Sequence[str]) -> None:
    """Render the test views of every saved iteration; those whose model is as it was then are left out.

    options: further words for render.py.
    """
    record = Record(run.model)
    iterations = saved_iterations(run.model / "point_cloud")
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
            raise StageFailed(Failure("render", command, ["there are no test views, so there is nothing to score"]))
        record.note(f"render_{iteration}", **wanted, views=views, wall_seconds=round(finished.seconds, 3))
        _stop_if_asked(finished)


def _stamp(file: Path) -> list[int]:
    """Tells whether a file is still the same, without reading it."""
    state = file.stat()
    return [state.st_size, state.st_mtime_ns]


def _rendered(model: Path, iteration: int) -> int:
    """Number of views of which both the render and the ground truth are there; 0 where one is missing."""
    folder = model / "test" / f"ours_{iteration}"
    renders, truth = view_names(folder / "renders"), view_names(folder / "gt")
    return len(renders) if renders == truth else 0


def score(run: Run) -> None:
    """metrics.py, unless the same renders are scored."""
    record = Record(run.model)
    iterations = saved_iterations(run.model / "point_cloud")
    methods = [f"ours_{iteration}" for iteration in iterations if _rendered(run.model, iteration)]
    if not methods:
        raise StageFailed(Failure("metrics", [], [f"{run.model} has no rendered test views; render them first"]))
    renders = {method: record.stage(f"render_{method[5:]}") for method in methods}
    done = record.stage("metrics")
    if done and done["renders"] == renders and None not in renders.values() and _scored(run.model, methods):
        return
    command = _script("metrics.py", "-m", str(run.model))
    _say("scoring")
    finished = run_child(command)
    _expect_success("metrics", command, finished)
    truth = ground_truth_digest(run.model, methods[-1])
    record.note("metrics", ground_truth_sha256=truth, renders=renders, wall_seconds=round(finished.seconds, 3))
    _stop_if_asked(finished)


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
