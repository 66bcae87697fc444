"""A run's part of report.json, read from its model folder."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

from evaluation.model_folder import (
    SCHEDULE,
    closing_lines,
    count_gaussians,
    load_scores,
    picture_name,
    picture_size,
    ply_file,
    shorter_ends_there,
    trained_gaussians,
    trained_iterations,
    training_seconds,
    view_names,
)
from evaluation.record import Record
from evaluation.runs import Run
from evaluation.stages import Failure, page_file
from records.curve_peak import CLEAR
from records.error_curve import NAME as CURVE
from records.error_curve import Row, best_test, read_curve, whole_sets
from scene.readers.info import HOLD
from utils.files.json_files import read_json
from utils.system_utils import UserError

MB = 1e6  # bytes
WORST = 3  # number of views with the lowest PSNR to show of each run


def read_run(run: Run, output: Path, failure: Failure | None) -> dict[str, Any]:
    """Return everything known of a run, as JSON; missing parts are null or empty. Paths are relative to `output`.

    finished: the last iteration is scored and no stage failed. open_ended: the training itself decided when to end. A
    damaged file counts as a failure. options, source, added_options: null if not known.
    """
    record = Record(run.model)
    trained = record.stage("train") or {}
    # With --skip_training, another program or other options than this command's may have made the model.
    known = record.key or (None if (run.model / "point_cloud").exists() else run.key)
    curve = _curve(run.model)
    result = {
        "added_options": list(run.added) if known == run.key else None,
        "config": run.config,
        "cpu_seconds": trained.get("cpu_seconds"),
        "conventions": (_json(run.model / "metrics_info.json") or {}).get("conventions", {}),
        "curve": curve,
        "final_iteration": None,
        "ground_truth_sha256": (record.stage("metrics") or {}).get("ground_truth_sha256"),
        "group": run.scene.group,
        "iterations": {},
        "lines": closing_lines(run.model),
        "machine": trained.get("machine") or {},
        "model": os.path.relpath(run.model, output),
        "options": known and known["options"],
        "open_ended": _open_ended(run, known),
        "page": _page(run, output),
        "peak": _peak(curve, run.model),
        "scene": run.scene.name,
        "seed": run.seed,
        "source": known and known["scene"],
        "split": None,
        "test_sizes": [],
        "views": {"test": None, "train": None},
        "wall_seconds": trained.get("wall_seconds"),
        "worst_views": [],
    }
    saved = trained_iterations(run.model)
    try:
        iterations = {str(n): _iteration(run.model, n, curve) for n in saved}
        if saved:  # the process trained to the end
            both = {"process_seconds": trained.get("wall_seconds"), "cpu_seconds": trained.get("cpu_seconds")}
            iterations[str(saved[-1])] |= both
        last = max((int(n) for n, values in iterations.items() if values["views"]), default=None)
        result |= {"final_iteration": last, "iterations": iterations}
        if last is not None:
            result |= {
                "split": _split(run.model, last),
                "test_sizes": _sizes(run.model, last),
                "views": _view_counts(run.model, last, iterations[str(last)]["views"]),
                "worst_views": _worst(run.model, last),
            }
    except UserError as error:
        failure = failure or Failure("report", [], [str(error)])
    result["failure"] = dataclasses.asdict(failure) if failure else None
    result["finished"] = not failure and bool(saved) and result["final_iteration"] == saved[-1]
    return result


def _open_ended(run: Run, known: dict[str, Any] | None) -> bool:
    options = tuple(known["options"]) if known else ()
    return (run.model / SCHEDULE).is_file() or dataclasses.replace(run, options=options).iterations is None


def _page(run: Run, output: Path) -> str | None:
    """Return the path of the model's HTML file, relative to the report, if full_eval.py --html_models has made it."""
    page = page_file(run.model, output)
    return os.path.relpath(page, output) if Record(run.model).stage("html") and page.is_file() else None


def _curve(model: Path) -> list[Row]:
    if not (model / CURVE).is_file():
        return []
    try:
        return read_curve(model / CURVE)
    except UserError as error:
        print(f"warning: {error}", file=sys.stderr)
        return []


def _iteration(model: Path, iteration: int, curve: list[Row]) -> dict[str, Any]:
    """Return the scores of metrics.py, time, size and memory at a saved iteration.

    gaussians: as trained, as published tables count; gaussians_saved: without those left out as unseen; ply_mb:
    megabytes (10^6 bytes) of the PLY.
    """
    method = f"ours_{iteration}"
    point = next((row for row in curve if row["iteration"] == iteration), {})
    # Take memory only from a point at this very iteration: that of an earlier point would be a lower bound.
    values: dict[str, Any] = {
        "PSNR": None,
        "SSIM": None,
        "LPIPS": None,
        "cpu_seconds": None,
        "fps": None,
        "gaussians": trained_gaussians(model, iteration),
        "gaussians_saved": count_gaussians(model, iteration),
        "peak_memory_mib": point.get("peak_memory_mib"),
        "ply_mb": ply_file(model, iteration).stat().st_size / MB,
        "process_seconds": None,
        "render_ms": None,
        "seconds": point.get("seconds") if (logged := training_seconds(model, iteration)) is None else logged,
        "views": 0,
    }
    try:
        means, per_view = load_scores(model, method)
    except UserError:
        return values
    times = _json(model / "test" / method / "render_times.json") or {}
    return values | {
        **{key: means.get(key) for key in ("PSNR", "SSIM", "LPIPS")},
        "fps": times.get("fps"),
        "render_ms": times.get("median_ms"),
        "views": len(per_view["PSNR"]),
    }


def _json(path: Path) -> Any | None:
    """Read a JSON file; None if it is missing or not JSON."""
    try:
        return read_json(path)
    except (OSError, ValueError, RecursionError):
        return None


def _peak(curve: list[Row], model: Path) -> dict[str, Any] | None:
    """Return the iteration at which test views were clearly better than at the end, its PSNR, and the loss since.

    shorter_ends_there: whether --iterations with that number gives that model.
    """
    curve = whole_sets(curve)
    best = best_test(curve)
    if best is None or curve[-1]["test_psnr"] is None or best["test_psnr"] - curve[-1]["test_psnr"] < CLEAR:
        return None
    lost = best["test_psnr"] - curve[-1]["test_psnr"]
    return {
        "iteration": best["iteration"],
        "lost": lost,
        "shorter_ends_there": shorter_ends_there(model),
        "test_psnr": best["test_psnr"],
    }


def _sizes(model: Path, iteration: int) -> list[list[int]]:
    """Return the distinct sizes [width, height] of the test views, in pixels, ascending."""
    folder = model / "test" / f"ours_{iteration}" / "gt"
    return [list(size) for size in sorted({picture_size(folder / name) for name in view_names(folder)})]


def _view_counts(model: Path, iteration: int, scored: int) -> dict[str, int | None]:
    """Count the training views and the scored test views. cameras.json lists all views, fully masked ones too."""
    cameras = _json(model / "cameras.json")
    held_out = len(view_names(model / "test" / f"ours_{iteration}" / "gt"))
    return {"test": scored, "train": len(cameras) - held_out if isinstance(cameras, list) else None}


def _split(model: Path, iteration: int) -> str | None:
    """Name the split, judging by the names in cameras.json, which lists test views first; None if it cannot tell."""
    cameras = _json(model / "cameras.json")
    try:
        names = [str(camera["img_name"]) for camera in cameras]
    except (KeyError, TypeError):
        return None
    held_out = len(view_names(model / "test" / f"ours_{iteration}" / "gt"))
    by_name = sorted(set(names), key=os.fsencode)
    return f"every {HOLD}th by name" if names[:held_out] == by_name[::HOLD] else "the data set's own"


def _worst(model: Path, iteration: int) -> list[dict[str, Any]]:
    """Return the test views with the lowest PSNR, worst first: PSNR, file, name of the photo.

    cameras.json has the names of the photos, test views first.
    """
    scores = load_scores(model, f"ours_{iteration}")[1]["PSNR"]
    worst = sorted((value, name) for name, value in scores.items() if value is not None)[:WORST]
    cameras = _json(model / "cameras.json")
    return [{"PSNR": value, "file": name, "picture": picture_name(cameras, name)} for value, name in worst]
