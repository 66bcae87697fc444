"""Comparable runs of a scene: those that were scored on the same ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any


def stand_apart(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the runs with `apart`: whether rankings and the Pareto front of the scene must leave the run out.

    Where a scene was scored on several ground truths, the one of most runs counts, the first of equals. An option set
    stands apart if any of its runs has another one, or none that is known.
    """
    marked = []
    for run in runs:
        members = [other for other in runs if other["scene"] == run["scene"]]
        known = Counter(other["ground_truth_sha256"] for other in members if other["ground_truth_sha256"])
        seeds = {other["ground_truth_sha256"] for other in members if other["config"] == run["config"]}
        apart = len(known) > 1 and seeds != {max(known, key=known.__getitem__)}
        marked.append({**run, "apart": apart})
    return marked
