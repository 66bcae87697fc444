"""Runs beside each other: spread over seeds, means of data sets, option sets of a scene, published tables.

Everything is made of the `runs` of report.json, and becomes a part of it.
"""

from __future__ import annotations

import re
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from applications.evaluation.plan import DATASETS
from arguments import OPTIONS, VIEW_OPTIONS
from groundwork.files.json_files import read_json
from splatting.records.renders import BESIDE, SCORES

OTHER_SCORES = tuple(f"PSNR_{name}" for name in BESIDE)
QUANTITIES = (
    *(*SCORES, "seconds", "joules", "process_seconds", "cpu_seconds", "gaussians", "gaussians_saved"),
    *("peak_memory_mib", "render_ms", "fps", "ply_mb", *OTHER_SCORES),
)
COMPARED = (*SCORES[:3], "seconds", "gaussians")  # with published numbers
DEFAULT = ("adc", "default", "defaults", "base")  # names of the set that others are compared with, the first there is
SHORTEST = 10.0  # seconds of a process whose share of the processors says something
EVEN = 0.8  # share of the best that trainings get on a machine of their own
DECIDING = {  # options of train.py that decide what test views show, and which of their pixels count
    word
    for option in OPTIONS
    if option.name in VIEW_OPTIONS - {"eval"} | {"masks", "invert_masks", "mask_meaning", "lenses"}
    for word in (f"--{option.name}", f"-{option.short}")
}

Run = Mapping[str, Any]
Sets = Mapping[str, Sequence[Run]]  # option set -> its runs, one for each seed


def summarise_spread(values: Iterable[float | None]) -> dict[str, Any]:
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


def group_by(items: Iterable[dict[str, Any]], *names: str) -> dict[Any, list[dict[str, Any]]]:
    """Group items by their value of a name, or values of several names, in the order of first occurrence."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for item in items:
        key = tuple(item[name] for name in names) if len(names) > 1 else item[names[0]]
        groups.setdefault(key, []).append(item)
    return groups


def summarise(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the spread of QUANTITIES over the seeds, for each scene, option set and scored iteration.

    Rows are in the order of `runs`. Seeds whose run failed are left out and listed as `failed_seeds`. Where the seeds
    were scored on different ground truth, scores have no mean. apart: see `mark_apart`. iteration: the
    mean of `iterations`, which are several where each seed ended by itself (`open_ended`).
    """
    rows = []
    for (scene, config), members in group_by(runs, "scene", "config").items():
        for at in _group_scored_runs([run for run in members if not run["failure"]]):
            there = [run for run, _ in at]
            row = {name: summarise_spread(run["iterations"][str(t)].get(name) for run, t in at) for name in QUANTITIES}
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


def _group_scored_runs(runs: Sequence[dict[str, Any]]) -> list[list[tuple[dict[str, Any], int]]]:
    """Group the runs of an option set, one for each seed, into the rows of a table: (run, scored iteration) each.

    Runs as long as --iterations says give a row for each iteration at which any of them was scored. Runs that end by
    themselves, each after another number of iterations, give the last row, of their final iterations.
    """
    fixed = [run for run in runs if not run["open_ended"]]
    scored = {int(n) for run in fixed for n, values in run["iterations"].items() if values["views"]}
    rows = [[(run, n) for run in fixed if run["iterations"].get(str(n), {}).get("views")] for n in sorted(scored)]
    ended = [(run, run["final_iteration"]) for run in runs if run["open_ended"] and run["finished"]]
    return [*rows, *([ended] if ended else [])]


def average_scenes(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of means over the scenes of a data set, for each option set and iteration that all of them have.

    They are like those of `summarise`, with the number of `scenes`. Where these have the same seeds, a mean is spread
    over them, too. iteration: null where the trainings ended by themselves.
    """
    means, scenes = [], {group: {row["scene"] for row in there} for group, there in group_by(rows, "group").items()}
    comparable = (row | {"iteration": None} if row["open_ended"] else row for row in rows if not row["apart"])
    for (group, config, iteration), members in group_by(comparable, "group", "config", "iteration").items():
        count = len(scenes[group])
        if count < 2 or {row["scene"] for row in members} != scenes[group]:
            continue
        seeds = members[0]["seeds"] if all(row["seeds"] == members[0]["seeds"] for row in members) else [None]
        of = "" if group not in DATASETS else f" of {group}"
        mean = {name: _average_spreads([row[name] for row in members], len(seeds)) for name in QUANTITIES}
        mean |= {"apart": False, "config": config, "group": group, "iteration": iteration, "scenes": count}
        whole = scenes[group] == DATASETS.get(group, {}).keys()
        means.append(mean | {"scene": f"mean{of}" if whole else f"mean of {count} scenes{of}", "seeds": seeds})
    return means


def _average_spreads(spreads: Sequence[dict[str, Any]], seeds: int) -> dict[str, Any]:
    """Return the spread of the mean over scenes. spreads: of a quantity, of each scene. seeds: 1 if they differ."""
    if seeds == 1 or any(one["mean"] is None for one in spreads):
        return summarise_spread(
            [None if None in (means := [one["mean"] for one in spreads]) else statistics.fmean(means)]
        )
    return summarise_spread(map(statistics.fmean, zip(*(one["values"] for one in spreads), strict=True)))


def mark_apart(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the runs with `apart`, whether comparisons of the scene must leave the run out, and `why_apart`.

    Where a scene was scored on several ground truths, the one of most runs counts, the first of equals. An option set
    stands apart if any of its runs has another one, or none that is known.
    """
    scenes, sets, marked = group_by(runs, "scene"), group_by(runs, "scene", "config"), []
    for run in runs:
        there = scenes[run["scene"]]
        known = Counter(filter(None, (other["ground_truth_sha256"] for other in there)))
        counts = max(known, key=known.__getitem__, default=None)
        seeds = {other["ground_truth_sha256"] for other in sets[run["scene"], run["config"]]}
        apart = len(known) > 1 and seeds != {counts}
        like = next(other for other in there if other["ground_truth_sha256"] == counts)
        marked.append({**run, "apart": apart, "why_apart": _explain_apart(run, seeds, like) if apart else None})
    return marked


def _explain_apart(run: Run, seeds: set[str | None], like: Run) -> str:
    """Return the known differences of a run's test views from those of the ground truth that counts.

    seeds: ground truths of the run's option set.
    like: a run with the ground truth that counts.
    """
    if run["ground_truth_sha256"] is None:
        return "its ground truth is not known"
    if len(seeds) > 1:
        return "its seeds were scored on different ground truth"
    (size, other_size), (count, other_count), (words, other_words) = (
        (" ".join(f"{w}x{h}" for w, h in one["test_sizes"]) for one in (run, like)),
        (one["views"]["test"] for one in (run, like)),
        (
            " ".join(filter(_decides_pixels, split_options(one["options"] or ()))) or "the defaults"
            for one in (run, like)
        ),
    )
    reasons = [f"its test views have {size} pixels, the others' {other_size}"] if size != other_size else []
    reasons += [f"it has {count} test views, the others {other_count}"] if count != other_count else []
    reasons = reasons or ["the pixels of its test views differ, or which of them count"]
    return "; ".join(reasons + ([f"{words} instead of {other_words}"] if words != other_words else []))


def split_options(words: Sequence[str]) -> list[str]:
    """Return each option of a command line with its values, as one text."""
    return re.split(r" (?=--?[a-zA-Z])", " ".join(words))


def _decides_pixels(option: str) -> bool:
    return re.split("[ =]", option)[0] in DECIDING


def find_comparable_sets(runs: Sequence[Run], scene: str) -> dict[str, list[Run]]:
    """Return the finished runs of a scene by option set, without sets that stand apart; none if there is but one."""
    known = (run for run in runs if run["config"] and run["finished"] and not run["apart"])
    sets = group_by((run for run in known if run["scene"] == scene), "config")
    return sets if len(sets) > 1 else {}


def choose_default_set(sets: Sets) -> str:
    """Return the name of the set that others are compared with: the first of DEFAULT, else the first set."""
    return next((name for name in DEFAULT if name in sets), next(iter(sets)))


def find_uneven_shares(runs: Iterable[Run]) -> tuple[float, float] | None:
    """Return the smallest and largest share of a processor that trainings had, if too unlike to compare seconds."""
    shares = [run["cpu_seconds"] / run["wall_seconds"] for run in runs
              if run["cpu_seconds"] is not None and (run["wall_seconds"] or 0) >= SHORTEST]  # fmt: skip
    return (min(shares), max(shares)) if shares and min(shares) <= EVEN * max(shares) else None


def read_published() -> list[dict[str, Any]]:
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

    runs, rows, means: those of report.json (`runs`, `summary`, `means`). In the result, `other_options` has the options
    of our training that the table's did not have (null: not known); they may explain a difference.
    """
    compared = []
    for table in read_published():
        for row in rows:
            ours = [run for run in runs if (run["scene"], run["config"]) == (row["scene"], row["config"])]
            theirs = table["scenes"].get(row["scene"], {}).get(str(None if row["open_ended"] else row["iteration"]))
            if theirs and row["group"] in table["groups"] and _meets_requirements(ours[0], table.get("requires", {})):
                compared.append(_compare_with(table, row, theirs, ours))
        for mean in means:
            theirs = table["means"].get(mean["group"], {}).get(str(mean["iteration"]))
            if theirs and mean["scenes"] == len(DATASETS[mean["group"]]):
                ours = [run for run in runs if (run["group"], run["config"]) == (mean["group"], mean["config"])]
                compared.append(_compare_with(table, mean, theirs, ours))
    return compared


def _meets_requirements(run: dict[str, Any], required: dict[str, Any]) -> bool:
    """Tell if a run has the test views, their sizes and the options that a published table was made with.

    required: `test_sizes`, `test_views` and `options`, each of which may be missing.
    """
    return (
        run["test_sizes"] == required.get("test_sizes", run["test_sizes"])
        and run["views"]["test"] == required.get("test_views", run["views"]["test"])
        and set(required.get("options", ())) <= set(run["options"] or ())
    )


def _compare_with(
    table: dict[str, Any], ours: dict[str, Any], theirs: dict[str, float], runs: list[dict[str, Any]]
) -> dict[str, Any]:
    """Compare a row of `summarise` or `average_scenes` with the same row of a published table."""
    numbers = {
        name: {"difference": mean - theirs[name], "ours": mean, "published": theirs[name]}
        for name in COMPARED
        if name in theirs and (mean := ours[name]["mean"]) is not None
    }
    facts = {"config": ours["config"], "iteration": ours["iteration"], "other_options": runs[0]["added_options"]}
    photos = ", ".join(dict.fromkeys(run["photos"] or "not known" for run in runs))
    facts |= {"hardware": table["hardware"], "numbers": numbers, "photos": photos}
    return facts | {"scene": ours["scene"], "table": table["name"]}
