"""Option sets of a scene that can be compared: their finished runs, the default among them, their final PSNR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evaluation.summary import spread
from records.error_curve import Row, whole_sets

DEFAULT = ("adc", "default", "defaults", "base")  # names of the set that others are compared with, the first there is

Sets = Mapping[str, Sequence[dict[str, Any]]]  # option set -> its runs, one for each seed


def comparable_sets(runs: Sequence[dict[str, Any]], scene: str) -> dict[str, list[dict[str, Any]]]:
    """Return the finished runs of a scene by option set, without sets that stand apart; none if there is but one."""
    sets: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        if run["scene"] == scene and run["config"] and run["finished"] and not run["apart"]:
            sets.setdefault(run["config"], []).append(run)
    return sets if len(sets) > 1 else {}


def default_set(sets: Sets) -> str:
    """Return the name of the set that others are compared with: the first of DEFAULT, else the first set."""
    return next((name for name in DEFAULT if name in sets), next(iter(sets)))


def scored(run: Mapping[str, Any]) -> list[Row]:
    """Return the points of a run's curve that score all test views."""
    return [row for row in whole_sets(run["curve"]) if row["test_psnr"] is not None]


def final_psnr(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the spread over the seeds of the test PSNR (dB) at the end of the curve."""
    return spread(rows[-1]["test_psnr"] if (rows := scored(run)) else None for run in runs)
