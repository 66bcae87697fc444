"""Runs beside each other: spread over seeds, means of data sets, option sets of a scene, published tables.

Everything is made of the `runs` of report.json, and becomes a part of it.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from arguments import OPTIONS, VIEW_OPTIONS
from splatting.evaluation.error_curve import Row, common_subset, rows_on
from splatting.evaluation.plan import DATASETS
from splatting.files.json_files import read_json

GIVEN_POSES = "given_poses"  # behind the name of renders and scores with the dataset's poses, where others were trained
FITTED = "fitted_appearance"  # the same of right halves, with the photos' appearance fitted to left ones
BESIDE = (GIVEN_POSES, FITTED)
SCORES = ("PSNR", "SSIM", "LPIPS", "DISTS")
OTHER_SCORES = tuple(f"PSNR_{name}" for name in BESIDE)
QUANTITIES = (
    *(*SCORES, "seconds", "joules", "process_seconds", "cpu_seconds", "gaussians", "gaussians_saved"),
    *("peak_memory_mib", "render_ms", "fps", "ply_mb", *OTHER_SCORES),
)
COMPARED = (*SCORES[:3], "seconds", "gaussians")  # with published numbers
DEFAULT = ("adc", "default", "defaults", "base")  # names of the set that others are compared with, the first there is
COSTS = ("seconds", "gaussians", "ply_mb")
DIGITS = 1e6  # of a PSNR in a curve
LOWEST = 2.0  # dB below the best final PSNR to which its levels go at least
SHORTEST = 10.0  # seconds of a process whose share of the processors says something
EVEN = 0.8  # share of the best that trainings get on a machine of their own
WIDEST_STEP = 2.0  # largest ratio of the seconds of two points to interpolate between; a wider gap tells too little
DECIDING = {  # options of train.py that decide what test views show, and which of their pixels count
    word
    for option in OPTIONS
    if option.name in VIEW_OPTIONS - {"eval"} | {"masks", "invert_masks", "mask_meaning", "lenses"}
    for word in (f"--{option.name}", f"-{option.short}")
}

Run = Mapping[str, Any]
Sets = Mapping[str, Sequence[Run]]  # option set -> its runs, one for each seed
Ends = Mapping[str, Any]  # spreads of PSNR and COSTS


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


def grouped(items: Iterable[dict[str, Any]], *names: str) -> dict[Any, list[dict[str, Any]]]:
    """Group items by their value of a name, or values of several names, in the order of first occurrence."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for item in items:
        key = tuple(item[name] for name in names) if len(names) > 1 else item[names[0]]
        groups.setdefault(key, []).append(item)
    return groups


def summarise(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the spread of QUANTITIES over the seeds, for each scene, option set and scored iteration.

    Rows are in the order of `runs`. Seeds whose run failed are left out and listed as `failed_seeds`. Where the seeds
    were scored on different ground truth, scores have no mean. apart: see `stand_apart`. iteration: the
    mean of `iterations`, which are several where each seed ended by itself (`open_ended`).
    """
    rows = []
    for (scene, config), members in grouped(runs, "scene", "config").items():
        for at in _moments([run for run in members if not run["failure"]]):
            there = [run for run, _ in at]
            row = {name: spread(run["iterations"][str(t)].get(name) for run, t in at) for name in QUANTITIES}
            iterations = sorted({t for _, t in at})
            one = len({run["ground_truth_sha256"] for run in there}) == 1
            if not one:
                row |= {name: row[name] | {"mean": None, "std": None} for name in (*SCORES, *OTHER_SCORES)}
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
    rows = [row | {"iteration": None} if row["open_ended"] else row for row in rows if row["group"] in DATASETS]
    means = []
    for (group, config, iteration), members in grouped(rows, "group", "config", "iteration").items():
        if {row["scene"] for row in members} == DATASETS[group].keys():
            mean = {name: spread(row[name]["mean"] for row in members)["mean"] for name in QUANTITIES}
            means.append({**mean, "config": config, "group": group, "iteration": iteration})
    return means


def stand_apart(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the runs with `apart`, whether rankings and fronts of the scene must leave the run out, and `why_apart`.

    Where a scene was scored on several ground truths, the one of most runs counts, the first of equals. An option set
    stands apart if any of its runs has another one, or none that is known.
    """
    scenes, sets, marked = grouped(runs, "scene"), grouped(runs, "scene", "config"), []
    for run in runs:
        there = scenes[run["scene"]]
        known = Counter(filter(None, (other["ground_truth_sha256"] for other in there)))
        counts = max(known, key=known.__getitem__, default=None)
        seeds = {other["ground_truth_sha256"] for other in sets[run["scene"], run["config"]]}
        apart = len(known) > 1 and seeds != {counts}
        like = next(other for other in there if other["ground_truth_sha256"] == counts)
        marked.append({**run, "apart": apart, "why_apart": _why(run, seeds, like) if apart else None})
    return marked


def _why(run: Run, seeds: set[str | None], like: Run) -> str:
    """Return in what a run's test views differ from those of the ground truth that counts, as far as is known.

    seeds: ground truths of the run's option set. like: a run with the ground truth that counts.
    """
    if run["ground_truth_sha256"] is None:
        return "its ground truth is not known"
    if len(seeds) > 1:
        return "its seeds were scored on different ground truth"
    (size, other_size), (count, other_count), (words, other_words) = (
        (" ".join(f"{w}x{h}" for w, h in one["test_sizes"]) for one in (run, like)),
        (one["views"]["test"] for one in (run, like)),
        (" ".join(filter(_decides, with_values(one["options"] or ()))) or "the defaults" for one in (run, like)),
    )
    reasons = [f"its test views have {size} pixels, the others' {other_size}"] if size != other_size else []
    reasons += [f"it has {count} test views, the others {other_count}"] if count != other_count else []
    reasons = reasons or ["the pixels of its test views differ, or which of them count"]
    return "; ".join(reasons + ([f"{words} instead of {other_words}"] if words != other_words else []))


def with_values(words: Sequence[str]) -> list[str]:
    """Return each option of a command line with its values, as one text."""
    return re.split(r" (?=--?[a-zA-Z])", " ".join(words))


def _decides(option: str) -> bool:
    return re.split("[ =]", option)[0] in DECIDING


def comparable_sets(runs: Sequence[Run], scene: str) -> dict[str, list[Run]]:
    """Return the finished runs of a scene by option set, without sets that stand apart; none if there is but one."""
    known = (run for run in runs if run["config"] and run["finished"] and not run["apart"])
    sets = grouped((run for run in known if run["scene"] == scene), "config")
    return sets if len(sets) > 1 else {}


def default_set(sets: Sets) -> str:
    """Return the name of the set that others are compared with: the first of DEFAULT, else the first set."""
    return next((name for name in DEFAULT if name in sets), next(iter(sets)))


def _line(run: Run, subset: int | None) -> list[Row]:
    """Return the points of a run's curve on a subset, None: all test views; none if the curve's end is not of them."""
    rows = [row for row in rows_on(run["curve"], subset) if row["test_psnr"] is not None]
    return rows if rows and rows[-1]["iteration"] == run["curve"][-1]["iteration"] else []


def seconds_to_reach(curve: Sequence[Row], level: float) -> float | None:
    """Return the seconds of training until the test PSNR first reaches `level` (dB); None if that is not known.

    curve: of scored rows. Between two, PSNR is taken as linear in the logarithm of the seconds. It is not known if no
    row reaches the level, if the first one does, or if the seconds more than double from the row before.
    """
    index = next((i for i, row in enumerate(curve) if row["test_psnr"] >= level), 0)
    row, before = curve[index], curve[index - 1]
    if not index or before["seconds"] <= 0 or row["seconds"] > WIDEST_STEP * before["seconds"]:
        return None
    part = (level - before["test_psnr"]) / (row["test_psnr"] - before["test_psnr"])
    return math.exp((1 - part) * math.log(before["seconds"]) + part * math.log(row["seconds"]))


def round_levels(finals: Sequence[float]) -> list[float]:
    """Return a few PSNRs (dB, descending) for the final ones of several sets.

    The first is the best final one, rounded down to half a dB; the others lie below it, denser near it, down to the
    first that all sets end above, and by LOWEST at least, since sets that end alike may differ on the way.
    """
    low, high = min(finals), math.floor(2 * max(finals)) / 2
    drops = [0.0, 0.5]
    while drops[-1] < LOWEST or high - drops[-1] >= low:
        drops.append(2 * drops[-1])
    return [high - drop for drop in drops]


def reached(sets: Sets) -> dict[str, Any] | None:
    """Return the table of a scene's sets; None if fewer than two have a curve to their end, of two points or more.

    default: the set that others are compared with. subset: how many of the `views` of the test set the PSNR is of,
    null: all. levels: `psnr`, and `of_default`: it is the mean PSNR at the end of that set. sets: by name the cells,
    one for each level (`_cell`), with `ratio`: its mean seconds as a part of the default's.

    A few views may rank the ends of runs in another way than all views do. Then all views decide whether a run ends as
    well as the default set.
    """
    every = [run for runs in sets.values() for run in runs]
    subset = common_subset(run["curve"] for run in every)
    curves = {name: [_line(run, subset) for run in runs] for name, runs in sets.items()}
    ends = {name: [rows[-1]["test_psnr"] for rows in seeds if len(rows) > 1] for name, seeds in curves.items()}
    finals = {name: statistics.fmean(values) for name, values in ends.items() if len(values) == len(curves[name])}
    if len(finals) < 2:
        return None
    default = default_set(finals)
    own = _floored(finals[default])
    round_ones = [level for level in round_levels(list(finals.values())) if abs(level - own) >= 0.005]
    levels = [{"psnr": level, "of_default": level == own} for level in sorted([*round_ones, own], reverse=True)]
    good = _as_good_at_the_end(sets, default)
    table = {
        name: [_cell(curves[name], **level, is_default=name == default, as_good=good[name]) for level in levels]
        for name in finals
    }
    for cells in table.values():
        for cell, theirs in zip(cells, table[default], strict=True):
            both = cell["seconds"]["mean"], theirs["seconds"]["mean"]
            cell["ratio"] = None if None in both or not both[1] else both[0] / both[1]
    views = every[0]["views"]["test"]
    return {"default": default, "levels": levels, "sets": table, "subset": subset, "views": views}


def _floored(mean: float) -> float:
    return math.floor(mean * DIGITS) / DIGITS  # a mean of equal numbers may exceed them by a bit


def _as_good_at_the_end(sets: Sets, default: str) -> dict[str, list[bool | None]]:
    """Return of each run whether all test views have the mean PSNR of the default set at its end; None: not known."""
    ends = {name: [[row["test_psnr"] for row in _line(run, None)][-1:] for run in runs] for name, runs in sets.items()}
    known = all(ends[default])
    least = _floored(statistics.fmean(end for (end,) in ends[default])) if known else math.nan
    return {name: [end[0] >= least if known and end else None for end in seeds] for name, seeds in ends.items()}


def _cell(
    curves: Sequence[Sequence[Row]], psnr: float, of_default: bool, is_default: bool, as_good: Sequence[bool | None]
) -> dict[str, Any]:
    """Return what the seeds of a set take to reach a level: spreads of seconds and Gaussians.

    Seeds that do not reach it have null, and so has the mean then. reached: the number of seeds that do; at_end:
    whether the seconds are all those of each seed. That is so only for the default's own end, unless each seed was as
    good before. at_most: whether a seed may have taken less. as_good: of `_as_good_at_the_end`.
    """
    asked = [good if of_default and not is_default else None for good in as_good]
    found = [_reach(curve, psnr, good) for curve, good in zip(curves, asked, strict=True)]
    rows, seconds, limits = zip(*found, strict=True)
    count, lasts = sum(row is not None for row in rows), [curve[-1] for curve in curves]
    at_end = of_default and is_default and any(row in (None, last) for row, last in zip(rows, lasts, strict=True))
    if at_end:
        rows, seconds = lasts, [row["seconds"] for row in lasts]
    return {
        "at_end": at_end,
        "at_most": any(limits),
        "gaussians": spread(row and row["gaussians"] for row in rows),
        "reached": count,
        "seconds": spread(seconds),
    }


def _reach(curve: Sequence[Row], level: float, as_good: bool | None) -> tuple[Row | None, float | None, bool]:
    """Return the first row of a curve that reaches a level, the seconds until then, and whether it may be fewer.

    It may where that is the curve's first row. None: no row does, or the seconds are not known. as_good: whether the
    curve does at its end, None: as its last row says.
    """
    row = next((row for row in curve if row["test_psnr"] >= level), None)
    if as_good in (None, curve[-1]["test_psnr"] >= level) or (as_good and row is not None):
        first = row is not None and row is curve[0]
        return row, row["seconds"] if first else seconds_to_reach(curve, level), first
    return (curve[-1], curve[-1]["seconds"], True) if as_good else (None, None, False)


def uneven_shares(runs: Iterable[Run]) -> tuple[float, float] | None:
    """Return the least and the most of a processor that trainings got, if they differ too much to compare seconds."""
    shares = [run["cpu_seconds"] / run["wall_seconds"] for run in runs
              if run["cpu_seconds"] is not None and (run["wall_seconds"] or 0) >= SHORTEST]  # fmt: skip
    return (min(shares), max(shares)) if shares and min(shares) <= EVEN * max(shares) else None


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (cost, error) that no other beats in both, by ascending cost.

    Of equal points it keeps the first.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if not front or points[index][1] < points[front[-1]][1]:
            front.append(index)
    return front


def fronts(sets: Sets) -> dict[str, Any] | None:
    """Return where each set ended, and which sets are on the Pareto front; None if fewer than two sets have scores.

    sets: by name the spreads over the seeds of PSNR (dB, of metrics.py), seconds of training, Gaussians trained and
    ply_mb, at the last iteration. beaten: for each cost and set, None if it is on the Pareto front, else `by` and
    `clearly` of `_beaten_by`. By seconds nothing is clear where the trainings got unequal shares of the processors.
    """
    points: dict[str, Ends] = {}
    uneven = uneven_shares([run for runs in sets.values() for run in runs])
    for name, runs in sets.items():
        ends = [run["iterations"][str(run["final_iteration"])] for run in runs]
        point = {key: spread(end[key] for end in ends) for key in ("PSNR", *COSTS)}
        if all(numbers["mean"] is not None for numbers in point.values()):
            points[name] = point
    if len(points) < 2:
        return None
    beaten = {cost: {name: _beaten_by(points, name, cost) for name in points} for cost in COSTS}
    for by in filter(None, beaten["seconds"].values()) if uneven else ():
        by["clearly"] = False
    return {"beaten": beaten, "sets": points}


def _beaten_by(points: Mapping[str, Ends], name: str, cost: str) -> dict[str, Any] | None:
    """Return the set that beats one, by the means: no worse in PSNR and cost, and better in one of them. None: none.

    by: of several, the one with the highest PSNR. clearly: whether one of them is better in PSNR and cost, each by more
    than the root of the sum of both squared standard deviations, or equal; null where one of these is not known, as
    with one seed.
    """
    rivals, clear = [], []
    for other, theirs in points.items():
        gains = [sign * (theirs[key]["mean"] - points[name][key]["mean"]) for key, sign in (("PSNR", 1), (cost, -1))]
        if min(gains) < 0 or max(gains) <= 0:
            continue
        rivals.append(other)
        pairs = [(theirs[key]["std"], points[name][key]["std"]) for key in ("PSNR", cost)]
        unknown = any(None in pair for pair in pairs)
        sure = (gain == 0 or gain > math.hypot(*pair) for gain, pair in zip(gains, pairs, strict=True) if not unknown)
        clear.append(None if unknown else all(sure))
    if not rivals:
        return None
    best = max(rivals, key=lambda other: (points[other]["PSNR"]["mean"], -points[other][cost]["mean"]))
    return {"by": best, "clearly": True if True in clear else None if None in clear else False}


def published_tables() -> list[dict[str, Any]]:
    """Read the published tables.

    A table has name, source, hardware and note. `groups` and `requires` tell which runs can be compared with it.
    `scenes` and `means` (of a group) have numbers by iteration. LPIPS: VGG on [0, 1]; seconds: on that hardware.
    mipnerf360_photos: which ones of that data set.
    """
    return read_json(Path(__file__).parent / "published.json")["tables"]


def compare(
    runs: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]], means: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Compare our numbers with each published one of the same scene (or mean of a data set) and iteration.

    runs, rows, means: those of report.json (`runs`, `summary`, `dataset_means`). In the result, `other_options` has the
    options of our training that the table's did not have (null: not known); they may explain a difference.
    """
    compared = []
    for table in published_tables():
        for row in rows:
            ours = [run for run in runs if (run["scene"], run["config"]) == (row["scene"], row["config"])]
            theirs = table["scenes"].get(row["scene"], {}).get(str(None if row["open_ended"] else row["iteration"]))
            if theirs and row["group"] in table["groups"] and _meets(ours[0], table.get("requires", {})):
                numbers = {name: row[name]["mean"] for name in COMPARED}
                compared.append(_comparison(table, row | numbers, row["scene"], theirs, ours))
        for mean in means:
            theirs = table["means"].get(mean["group"], {}).get(str(mean["iteration"]))
            if theirs:
                ours = [run for run in runs if (run["group"], run["config"]) == (mean["group"], mean["config"])]
                compared.append(_comparison(table, mean, f"mean of {mean['group']}", theirs, ours))
    return compared


def _meets(run: dict[str, Any], required: dict[str, Any]) -> bool:
    return (
        run["test_sizes"] == required.get("test_sizes", run["test_sizes"])
        and run["views"]["test"] == required.get("test_views", run["views"]["test"])
        and set(required.get("options", ())) <= set(run["options"] or ())
    )


def _comparison(
    table: dict[str, Any], ours: dict[str, Any], scene: str, theirs: dict[str, float], runs: list[dict[str, Any]]
) -> dict[str, Any]:
    numbers = {
        name: {"difference": ours[name] - theirs[name], "ours": ours[name], "published": theirs[name]}
        for name in COMPARED
        if name in theirs and ours[name] is not None
    }
    facts = {"config": ours["config"], "iteration": ours["iteration"], "other_options": runs[0]["added_options"]}
    photos = ", ".join(dict.fromkeys(run["photos"] or "not known" for run in runs))
    facts |= {"hardware": table["hardware"], "numbers": numbers, "photos": photos}
    return facts | {"scene": scene, "table": table["name"]}
