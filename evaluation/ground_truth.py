"""Comparable runs of a scene: those that were scored on the same ground truth."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

DECIDING = {
    *("--resolution", "-r", "--images", "-i", "--white_background", "-w", "--train_test_exp"),
    *("--masks", "--invert_masks", "--mask_meaning"),
}  # options of train.py


def stand_apart(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the runs with `apart`, whether rankings and fronts of the scene must leave the run out, and `why_apart`.

    Where a scene was scored on several ground truths, the one of most runs counts, the first of equals. An option set
    stands apart if any of its runs has another one, or none that is known.
    """
    marked: list[dict[str, Any]] = []
    for run in runs:
        members = [other for other in runs if other["scene"] == run["scene"]]
        known = Counter(other["ground_truth_sha256"] for other in members if other["ground_truth_sha256"])
        seeds = {other["ground_truth_sha256"] for other in members if other["config"] == run["config"]}
        apart = len(known) > 1 and seeds != {max(known, key=known.__getitem__)}
        marked.append({**run, "apart": apart})
    return [{**run, "why_apart": _why(run, marked) if run["apart"] else None} for run in marked]


def _why(run: dict[str, Any], runs: Sequence[dict[str, Any]]) -> str:
    """Return in what a run's test views differ from those of the comparable runs of its scene, as far as is known."""
    digest = run["ground_truth_sha256"]
    if digest is None:
        return "its ground truth is not known"
    seeds = [other for other in runs if (other["scene"], other["config"]) == (run["scene"], run["config"])]
    if len({other["ground_truth_sha256"] for other in seeds}) > 1:
        return "its seeds were scored on different ground truth"
    other = next(other for other in runs if other["scene"] == run["scene"] and not other["apart"])
    reasons = []
    if run["test_sizes"] != other["test_sizes"]:
        ours, theirs = (" ".join(f"{w}x{h}" for w, h in one["test_sizes"]) for one in (run, other))
        reasons.append(f"its test views have {ours} pixels, the others' {theirs}")
    if run["views"]["test"] != other["views"]["test"]:
        reasons.append(f"it has {run['views']['test']} test views, the others {other['views']['test']}")
    reasons = reasons or ["the pixels of its test views differ, or which of them count"]
    ours, theirs = (_of_ground_truth(one["options"] or ()) for one in (run, other))
    if ours != theirs:
        reasons.append(f"{' '.join(ours) or 'the defaults'} instead of {' '.join(theirs) or 'the defaults'}")
    return "; ".join(reasons)


def _of_ground_truth(options: Sequence[str]) -> list[str]:
    """Return those of train.py's words that decide what test views show, and which of their pixels count."""
    words: list[str] = []
    taken = False
    for word in options:
        if re.match("--?[a-zA-Z]", word):
            taken = word.split("=")[0] in DECIDING
        words += [word] if taken else []
    return words
