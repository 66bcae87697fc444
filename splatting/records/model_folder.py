"""Readers of a model folder: number of Gaussians, curve, log, scores."""

import re
import sys
from pathlib import Path
from typing import Any

from groundwork.files.json_files import read_json, read_model_json
from groundwork.files.plain_files import plain_path
from splatting.records.error_curve import NAME as CURVE
from splatting.records.error_curve import Row, read_curve
from splatting.records.training_log import NAME as LOG
from splatting.records.training_log import read_log
from utils.system_utils import UserError, saved_iterations, saved_ply


def json_or_none(path: Path) -> Any | None:
    """Read a JSON file; None if it is missing or not JSON."""
    try:
        return read_json(path)
    except (OSError, ValueError, RecursionError):
        return None


def count_gaussians(model: Path, iteration: int) -> int:
    """Read the number of Gaussians of a saved iteration from the header of its PLY."""
    ply = saved_ply(model, iteration)
    try:
        with open(plain_path(ply), "rb") as file:
            header = file.read(4096).split(b"end_header")[0]
    except OSError as error:
        raise UserError(f"cannot read {ply} ({error.strerror}); train the model again") from error
    found = re.search(rb"element vertex (\d+)", header)
    if not found:
        raise UserError(f"{ply} is not a PLY of Gaussians; train the model again")
    return int(found[1])


def trained_gaussians(model: Path, iteration: int) -> int:
    """Return the number of Gaussians that were trained: those of the PLY, and those left out as unseen."""
    saved = count_gaussians(model, iteration)
    try:
        left_out = read_model_json(model).get("left_out") or {}
        trained, unseen = int(left_out["gaussians"]), int(left_out["unseen"])
    except (UserError, KeyError, TypeError, ValueError):
        return saved  # a model of another program, which leaves nothing out
    return trained if iteration == trained_iterations(model)[-1] and trained - unseen == saved else saved


def load_scores(model: Path, method: str) -> tuple[dict[str, float | None], dict[str, dict[str, float | None]]]:
    """Read metrics.py's scores of a method: the means, and the scores by metric and view. UserError without them."""
    try:
        results = read_json(model / "results.json")[method]
        per_view = read_json(model / "per_view.json")[method]
        for numbers in ({key: results[key] for key in ("PSNR", "SSIM")}, per_view["PSNR"]):
            if not numbers or any(type(value) not in (int, float, type(None)) for value in numbers.values()):
                raise ValueError("no numbers")
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{model} has no scores of {method}; run render.py and metrics.py -m {model} first") from error
    return results, per_view


def curve_of(model: Path) -> list[Row]:
    """Read the points of the training's curve; none if it has none. UserError if the file is damaged."""
    return read_curve(model / CURVE) if (model / CURVE).is_file() else []


def training_seconds(model: Path, iteration: int) -> float | None:
    """Read the seconds of training until an iteration, without tests and saving; None if train.py logged none."""
    return logged(model, warn=True).get(iteration, {}).get("seconds")


def training_joules(model: Path, iteration: int) -> float | None:
    """Read the joules of the GPUs in these seconds of training; None if they are not known."""
    return logged(model).get(iteration, {}).get("joules")


def logged(model: Path, warn: bool = False) -> dict[int, dict[str, Any]]:
    """Read the records of train_log.json by their iterations; none without the file, or if it is damaged."""
    try:
        return {record["iteration"]: record for record in read_log(model / LOG)}
    except UserError as error:
        if warn:
            print(f"warning: {error}", file=sys.stderr)
        return {}


def trained_iterations(model: Path) -> list[int]:
    """List the saved iterations of the training that the log describes, ascending.

    Where the clock ends a training, an earlier one of the same options may have left a later iteration.
    """
    saved, end = saved_iterations(model / "point_cloud"), max(logged(model), default=None)
    return saved if end not in saved else [iteration for iteration in saved if iteration <= end]


def closing_lines(model: Path) -> list[str]:
    """Read the lines that train.py printed at its end: costs of the curve, what it left out; none without a log."""
    lines = next(reversed(logged(model).values()), {}).get("lines")
    return list(map(str, lines)) if isinstance(lines, list) else []
