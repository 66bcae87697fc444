"""Mean and spread over seeds, and means over a data set."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from splatting.evaluation.scenes import DATASETS

SCORES = ("PSNR", "SSIM", "LPIPS")
QUANTITIES = (
    *(*SCORES, "seconds", "process_seconds", "cpu_seconds", "gaussians", "gaussians_saved", "peak_memory_mib"),
    *("render_ms", "fps", "ply_mb"),
)


def spread(values: Iterable[float | None]) -> dict[str, Any]:
    """Return the mean, the sample standard deviation (with n - 1; None for one value) and the values.

    The mean is None if any value is: a mean over fewer seeds could not be compared.
    """
    numbers = list(values)
    known = bool(numbers) and None not in numbers
    return {
        "mean": statistics.fmean(numbers) if known else None,
        "std": statistics.stdev(numbers) if known and len(numbers) > 1 else None,
        "values": numbers,
    }


def summarise(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the spread of QUANTITIES over the seeds, for each scene, option set and scored iteration.

    Rows are in the order of `runs`. Seeds whose run failed are left out and listed as `failed_seeds`. Where the seeds
    were scored on different ground truth, scores have no mean. apart: see `ground_truth.stand_apart`. iteration: the
    mean of `iterations`, which are several where each seed ended by itself (`open_ended`).
    """
    cells: dict[tuple, list[dict[str, Any]]] = {}
    for run in runs:
        cells.setdefault((run["scene"], run["config"]), []).append(run)
    rows = []
    for (scene, config), members in cells.items():
        for at in _moments([run for run in members if not run["failure"]]):
            there = [run for run, _ in at]
            row = {name: spread(run["iterations"][str(t)][name] for run, t in at) for name in QUANTITIES}
            iterations = sorted({t for _, t in at})
            one = len({run["ground_truth_sha256"] for run in there}) == 1
            if not one:
                row |= {name: row[name] | {"mean": None, "std": None} for name in SCORES}
            row |= {
                "apart": any(run["apart"] for run in there),
                "config": config,
                "failed_seeds": [run["seed"] for run in members if run["failure"]],
                "group": members[0]["group"],
                "iteration": round(statistics.fmean(t for _, t in at)),
                "iterations": iterations,
                "open_ended": any(run["open_ended"] for run in there),
                "one_ground_truth": one,
                "scene": scene,
                "seeds": [run["seed"] for run in there],
                "why_apart": next((run["why_apart"] for run in there if run["apart"]), None),
            }
            rows.append(row)
    return rows


def _moments(runs: Sequence[dict[str, Any]]) -> list[list[tuple[dict[str, Any], int]]]:
    """Return what the rows of an option set are about: in each, runs with a scored iteration.

    It is the same iteration of all, and the last one of runs that ended by themselves.
    """
    fixed = [run for run in runs if not run["open_ended"]]
    scored = {int(n) for run in fixed for n, values in run["iterations"].items() if values["views"]}
    rows = [[(run, n) for run in fixed if run["iterations"].get(str(n), {}).get("views")] for n in sorted(scored)]
    ended = [(run, run["final_iteration"]) for run in runs if run["open_ended"] and run["finished"]]
    return [*rows, *([ended] if ended else [])]


def dataset_means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return means over the scenes of a data set, for each option set and iteration that all its scenes have.

    iteration: null where the trainings ended by themselves.
    """
    cells: dict[tuple, dict[str, dict[str, Any]]] = {}
    for row in rows:
        if row["group"] in DATASETS:
            iteration = None if row["open_ended"] else row["iteration"]
            cells.setdefault((row["group"], row["config"], iteration), {})[row["scene"]] = row
    means = []
    for (group, config, iteration), scenes in cells.items():
        if scenes.keys() == DATASETS[group].keys():
            mean = {name: spread(row[name]["mean"] for row in scenes.values())["mean"] for name in QUANTITIES}
            means.append({**mean, "config": config, "group": group, "iteration": iteration})
    return means
