"""A run's part of report.json, read from its model folder; and runs of earlier calls, which stay in it."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

from applications.evaluation.plan import Record, Run, SceneEntry, describe_photos, is_model
from applications.evaluation.stages import Failure, page_file
from arguments import read_model_json, read_stored_options
from groundwork.files.json_files import SCHEDULE, read_json
from scene.gaussians.sh_bands import SH_INTERVAL
from scene.readers.info import HOLD
from splatting.records import model_folder as folder_of
from splatting.records.error_curve import Row, gain_since_peak, peak
from splatting.records.renders import BESIDE, SCORES, TIMES, image_size, view_names, worst_views
from splatting.records.training_log import DEGREES, PERCENT
from splatting.registry import PARTS
from utils.system_utils import UserError, saved_ply

REPORT = "report.json"
MB = 1e6  # bytes


def read_run(run: Run, output: Path, failure: Failure | None) -> dict[str, Any]:
    """Return everything known of a run, as JSON; missing parts are null or empty. Paths are relative to `output`.

    finished: the last iteration is scored and no stage failed. open_ended: the training itself decided when to end. A
    damaged file counts as a failure. options, source, photos (in words), added_options: null if not known. peak: the
    iteration at which test views were clearly better than at the end, its PSNR, and the loss since; gained: by training
    views since then, null if not clearly; shorter_ends_there: whether --iterations with that number gives that model.
    poses: seconds and the mean correction of refined poses.
    """
    model, record = run.model, Record(run.model)
    trained = record.stage("train") or {}
    # With --skip_training, another program or other options than this command's may have made the model.
    known = record.key or (None if (model / "point_cloud").exists() else run.key)
    options = tuple(known["options"]) if known else ()
    curve, best, page = _read_curve(model), None, page_file(model, output)
    if found := peak(curve):
        best = {"iteration": found[0]["iteration"], "test_psnr": found[0]["test_psnr"], "lost": found[1],
                "gained": gain_since_peak(curve),
                "shorter_ends_there": shorter_ends_there(model, found[0]["iteration"])}  # fmt: skip
    saved = folder_of.trained_iterations(model)
    views = {"final_iteration": None, "iterations": {}, "split": None, "test_sizes": [], "worst_views": [],
             "views": {"test": None, "train": None}}  # fmt: skip
    try:
        iterations = {str(n): _read_iteration(model, n, curve) for n in saved}
        if saved:  # the process trained to the end
            both = {"process_seconds": trained.get("wall_seconds"), "cpu_seconds": trained.get("cpu_seconds")}
            iterations[str(saved[-1])] |= both
        last = max((int(n) for n, values in iterations.items() if values["views"]), default=None)
        views |= {"final_iteration": last, "iterations": iterations}
        views |= {} if last is None else _read_views(model, last)
    except UserError as error:
        failure = failure or Failure("report", [], [str(error)])
    return views | {
        "added_options": list(run.added) if known == run.key else None,
        "config": run.config,
        "cpu_seconds": trained.get("cpu_seconds"),
        "conventions": (folder_of.json_or_none(model / "metrics_info.json") or {}).get("conventions", {}),
        "curve": curve,
        "failure": dataclasses.asdict(failure) if failure else None,
        "finished": not failure and bool(saved) and views["final_iteration"] == saved[-1],
        "ground_truth_sha256": (record.stage("metrics") or {}).get("ground_truth_sha256"),
        "group": run.scene.group,
        "lines": folder_of.closing_lines(model),
        "machine": trained.get("machine") or {},
        "model": os.path.relpath(model, output),
        "options": known and known["options"],
        "open_ended": (model / SCHEDULE).is_file() or dataclasses.replace(run, options=options).iterations is None,
        "photos": describe_photos(known["options"]) if known else None,
        "page": os.path.relpath(page, output) if record.stage("html") and page.is_file() else None,
        "peak": best,
        "poses": [[r["seconds"], r[DEGREES], r[PERCENT]] for r in folder_of.logged(model).values() if DEGREES in r],
        "scene": run.scene.name,
        "seed": run.seed,
        "source": known and known["scene"],
        "wall_seconds": trained.get("wall_seconds"),
    }


def _read_curve(model: Path) -> list[Row]:
    """Read the rows of a model's error curve; none, with a warning, if its file is damaged."""
    try:
        return folder_of.curve_of(model)
    except UserError as error:
        print(f"warning: {error}", file=sys.stderr)
        return []


def _read_views(model: Path, last: int) -> dict[str, Any]:
    """Return what is known of the test views of the last scored iteration.

    cameras.json lists all views, test views first, fully masked ones too. worst_views: those of the lowest PSNR, worst
    first; split: how they were held out, by --holdout or judging by their names, null if that cannot be told;
    test_sizes: distinct ones [width, height] in pixels, ascending; views: training views and scored test views.
    """
    truth = model / "test" / f"ours_{last}" / "gt"
    held_out, cameras = view_names(truth), folder_of.json_or_none(model / "cameras.json")
    scores = folder_of.load_scores(model, f"ours_{last}")[1]["PSNR"]
    return {
        "split": _split_views(model, cameras, len(held_out)),
        "test_sizes": [list(size) for size in sorted({image_size(truth / name) for name in held_out})],
        "views": {"test": len(scores), "train": len(cameras) - len(held_out) if isinstance(cameras, list) else None},
        "worst_views": worst_views(model, scores),
    }


def _split_views(model: Path, cameras: Any, held_out: int) -> str | None:
    """Say how the test views were chosen, as an option of train.py or in words; None: not known.

    cameras: the entries of cameras.json, test views first.
    held_out: number of test views.
    """
    if rule := read_model_json(model).get("holdout"):
        return f"--holdout {rule}"
    try:
        names = [str(camera["img_name"]) for camera in cameras]
    except (KeyError, TypeError):
        return None
    by_name = sorted(set(names), key=os.fsencode)
    return f"every {HOLD}th by name" if names[:held_out] == by_name[::HOLD] else "the data set's own"


def _read_iteration(model: Path, iteration: int, curve: list[Row]) -> dict[str, Any]:
    """Return the scores of metrics.py, time, size and memory at a saved iteration.

    gaussians: as trained, as published tables count; gaussians_saved: without those left out as unseen; ply_mb:
    megabytes (10^6 bytes) of the PLY.
    """
    method = f"ours_{iteration}"
    point = next((row for row in curve if row["iteration"] == iteration), {})
    try:
        means, per_view = folder_of.load_scores(model, method)
    except UserError:
        means, per_view, times = {}, {"PSNR": {}}, {}
    else:
        times = folder_of.json_or_none(model / "test" / method / TIMES) or {}
    seconds = folder_of.training_seconds(model, iteration)
    scores = folder_of.json_or_none(model / "results.json") or {}
    return {
        **{key: means.get(key) for key in SCORES},
        **{f"PSNR_{name}": scores.get(f"{method}_{name}", {}).get("PSNR") for name in BESIDE},
        "cpu_seconds": None,
        "fps": times.get("fps"),
        "gaussians": folder_of.trained_gaussians(model, iteration),
        "gaussians_saved": folder_of.count_gaussians(model, iteration),
        "joules": folder_of.training_joules(model, iteration),
        # Only of a point at this very iteration: the memory of an earlier one would be a lower bound.
        "peak_memory_mib": point.get("peak_memory_mib"),
        "ply_mb": saved_ply(model, iteration).stat().st_size / MB,
        "process_seconds": None,
        "render_ms": times.get("median_ms"),
        "seconds": point.get("seconds") if seconds is None else seconds,
        "views": len(per_view["PSNR"]),
    }


def read_earlier(output: Path) -> dict[str, Any]:
    """Read what the report in an output folder shows, from its report.json.

    Return a dictionary:
    runs: (run, failure or None) by model folder; runs whose folder is gone are left out;
    peers: curves of other programs (--peer), as `error_curve.peers_of` returns them;
    commands: the commands that made the report, each a list of words;
    scored: true if the report has any score.
    """
    nothing = {"runs": {}, "peers": [], "commands": [], "scored": False}
    path = output / REPORT
    if not path.is_file():
        return nothing
    try:
        report = read_json(path)
        runs = [_restore_run(content, output) for content in report["runs"]]
        manifest = report["manifest"]
        return {
            "runs": {run.model: (run, failure) for run, failure in runs if is_model(run.model)},
            "peers": list(report.get("peers", [])),
            "commands": [
                list(map(str, words)) for words in [*manifest.get("earlier_commands", []), manifest["command"]]
            ],
            "scored": bool(report["summary"]),
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        print(f"warning: {path} is damaged ({error}); a new report is started", file=sys.stderr)
        return nothing


def _restore_run(content: dict[str, Any], output: Path) -> tuple[Run, Failure | None]:
    """Make a run and its failure, if any, from its entry in report.json. output: folder of the report."""
    source = content["source"]
    scene = SceneEntry(content["scene"], content["group"], source and Path(source))
    options, added = tuple(content["options"] or ()), tuple(content["added_options"] or ())
    run = Run(scene, content["config"], content["seed"], output / content["model"], options, added)
    return run, Failure(**content["failure"]) if content["failure"] else None


def shorter_ends_there(model: Path, iterations: int) -> bool:
    """Tell whether a training of so many --iterations ends with the model that a longer one has then.

    False if that is not known, and for so few that SH bands are raised sooner.
    """
    if (model / SCHEDULE).is_file() or iterations < SH_INTERVAL:
        return False
    try:
        options = read_stored_options(model)
    except UserError:
        return False
    return not any(part.needs.length and part.asked_by(argparse.Namespace(**options)) for part in PARTS)
