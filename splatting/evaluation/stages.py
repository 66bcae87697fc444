"""The stages train, render, score and page. Each is a subprocess, and is skipped silently if it is finished."""

from __future__ import annotations

import math
import re
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from splatting.evaluation import render_times
from splatting.evaluation.child import Finished, run_child
from splatting.evaluation.model_folder import (
    ground_truth_digest,
    load_scores,
    logged,
    ply_file,
    trained_iterations,
    view_names,
)
from splatting.evaluation.runs import Record, Run
from utils.system_utils import UserError, mkdir_p

_ROOT = Path(__file__).resolve().parents[2]
_OFFLINE = {"GS_DOWNLOAD": "0"}


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
    before = record.stage("train_interrupted") or {}
    before = before if before.get("checkpoint") in [path.name for path in _checkpoints(run)] else {}
    checkpoint = run.model / before["checkpoint"] if before else None
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
            stopped = done.interrupt and done.status in (128 + signal.SIGINT, 128 + signal.SIGTERM)
            name = max(left, key=_iteration_of).name
            record.note("train_interrupted" if stopped else "train_failed", checkpoint=name, **spent)
    _expect_success("train", command, done)
    iterations = trained_iterations(run.model)
    if (run.iterations or max(logged(run.model), default=None)) not in iterations:
        raise StageFailed(Failure("train", command, [f"train.py succeeded, but {run.model} lacks the last iteration"]))
    record.note("train", iterations=iterations, machine=machine, **spent)
    _stop_if_asked(done)


def _sum(before: dict[str, Any], done: Finished) -> dict[str, float | None]:
    """Return the seconds of a training with those of its parts before; CPU seconds None if not known."""
    sums = {}
    for name, seconds in (("wall_seconds", done.seconds), ("cpu_seconds", done.cpu_seconds)):
        earlier = before.get(name) if before else 0.0
        sums[name] = None if None in (earlier, seconds) else round(earlier + seconds, 3)
    return sums


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


def _from_where(checkpoint: Path | None, record: Record) -> str:
    if checkpoint:
        return f" from {checkpoint.name}"
    if failed := record.stage("train_failed"):
        return (
            f" from the start ({failed['checkpoint']} was left by a training that failed after "
            f"{failed['wall_seconds']:.0f} s)"
        )
    return ""


def _saved(run: Run, stage: str) -> list[int]:
    if iterations := trained_iterations(run.model):
        return iterations
    raise StageFailed(Failure(stage, [], [f"{run.model} has no saved iteration; train it first"]))


def _source(run: Run) -> tuple[str, ...]:
    return ("-s", str(run.scene.source)) if run.scene.source else ()


def _once(
    record: Record, name: str, say: str, command: list[str], wanted: dict[str, Any],
    found: Callable[[], dict[str, Any] | None], also: Callable[[], dict[str, Any]] = dict, **environment: str,
) -> None:  # fmt: skip
    """Run a command, unless its stage is noted as done with what is wanted and what is found.

    found: tells of the stage's files, None where they are missing; also: what is noted besides.
    """
    noted, there = record.stage(name), found()
    if noted and there is not None and {key: noted.get(key) for key in wanted | there} == wanted | there:
        return
    _say(say)
    done, stage = run_child(command, **environment), name.partition("_")[0]
    _expect_success(stage, command, done)
    there = found()
    if there is None:
        raise StageFailed(Failure(stage, command, ["the scene has no test views, so there is nothing to score"]))
    record.note(name, **wanted, **there, **also(), wall_seconds=round(done.seconds, 3))
    _stop_if_asked(done)


def render(run: Run, options: Sequence[str]) -> None:
    """Render the test views of every saved iteration, except those already rendered from the same model.

    options: more words for render.py.
    """
    for iteration in _saved(run, "render"):
        command = _script("render.py", "-m", str(run.model), *_source(run), "--iteration", str(iteration))
        command += ["--skip_train", "--eval", "--quiet", *options]
        wanted = {"model": _stamp(ply_file(run.model, iteration)), "options": list(options)}
        say = f"rendering iteration {iteration}"
        _once(Record(run.model), f"render_{iteration}", say, command, wanted, partial(_rendered, run.model, iteration))


def _stamp(file: Path) -> list[int]:
    """Return size and time of a file, to tell whether it changed without reading it."""
    state = file.stat()
    return [state.st_size, state.st_mtime_ns]


def _rendered(model: Path, iteration: int) -> dict[str, int] | None:
    """Return the number of rendered `views`; None if there are none, or a render or a ground truth is missing."""
    folder = model / "test" / f"ours_{iteration}"
    renders, truth = view_names(folder / "renders"), view_names(folder / "gt")
    return {"views": len(renders)} if renders and renders == truth else None


def score(run: Run, download: bool = True) -> bool:
    """Run metrics.py, unless the same renders are already scored.

    download: whether it may try to download the weights of LPIPS; return whether another run may. A try without an
    answer takes 10 seconds.
    """
    record, model = Record(run.model), run.model
    methods = [f"ours_{iteration}" for iteration in trained_iterations(model) if _rendered(model, iteration)]
    if not methods:
        raise StageFailed(Failure("metrics", [], [f"{model} has no rendered test views; render them first"]))
    renders = {method: _times_stamp(model, method) for method in methods}
    if None in renders.values() or not _scored(model, methods):
        record.forget("metrics")
    before = record.stage("metrics")
    _once(
        record, "metrics", "scoring", _script("metrics.py", "-m", str(model)), {"renders": renders}, dict,
        lambda: {"ground_truth_sha256": ground_truth_digest(model, methods[-1])}, **({} if download else _OFFLINE),
    )  # fmt: skip
    if record.stage("metrics") is before:
        return download
    return download and load_scores(model, methods[-1])[0].get("LPIPS") is not None


def page_file(model: Path, output: Path) -> Path:
    """Return the path of a model's HTML file, beside the report in the folder `output`."""
    return output / "models" / f"{model.relative_to(output)}.html"


def page(run: Run, output: Path, options: Sequence[str]) -> None:
    """Write the last saved iteration as one HTML file, unless it was made of the same model.

    options: more words for export.py.
    """
    last, file = _saved(run, "html")[-1], page_file(run.model, output)
    mkdir_p(file.parent)
    command = _script("export.py", "-m", str(run.model), *_source(run), "--iteration", str(last))
    command += ["--to", str(file), *options]
    wanted = {"model": _stamp(ply_file(run.model, last)), "options": list(options)}
    say = "writing the model as a page"
    _once(Record(run.model), "html", say, command, wanted, lambda: {} if file.is_file() else None)


def _times_stamp(model: Path, method: str) -> list[int] | None:
    """Return the `_stamp` of the file that render.py writes last, to tell whether renders changed; None without it."""
    times = model / "test" / method / render_times.NAME
    return _stamp(times) if times.is_file() else None


def _scored(model: Path, methods: Sequence[str]) -> bool:
    try:
        return all(load_scores(model, method) for method in methods)
    except UserError:
        return False


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
