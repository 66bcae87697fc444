"""Pareto fronts over the option sets of a scene: test PSNR against seconds, Gaussians, and megabytes of the PLY."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from evaluation.option_sets import Sets
from evaluation.summary import spread

COSTS = ("seconds", "gaussians", "ply_mb")

Point = Mapping[str, Any]  # spreads of PSNR and COSTS


def fronts(sets: Sets) -> dict[str, Any] | None:
    """Return where each set ended, and which sets no other one beats; None if fewer than two sets have scores.

    sets: by name the spreads over the seeds of PSNR (dB, of metrics.py), seconds of training, Gaussians trained and
    ply_mb, at the last iteration. beaten: for each cost and set, None if it is on the front, else `by` and `clearly` of
    `beaten_by`.
    """
    points = {name: _point(runs) for name, runs in sets.items()}
    points = {name: point for name, point in points.items() if None not in [point[key]["mean"] for key in point]}
    if len(points) < 2:
        return None
    beaten = {cost: {name: beaten_by(points, name, cost) for name in points} for cost in COSTS}
    return {"beaten": beaten, "sets": points}


def _point(runs: Sequence[Mapping[str, Any]]) -> Point:
    ends = [run["iterations"][str(run["final_iteration"])] for run in runs]
    return {key: spread(end[key] for end in ends) for key in ("PSNR", *COSTS)}


def beaten_by(points: Mapping[str, Point], name: str, cost: str) -> dict[str, Any] | None:
    """Return the set that beats one, by the means: no worse in PSNR and cost, and better in one of them. None: none.

    by: of several, the one with the highest PSNR. clearly: whether one of them is better in PSNR or cost by more than
    the root of the sum of both squared standard deviations; null where one of these is not known, as with one seed.
    """
    ours = points[name]
    rivals = [other for other, theirs in points.items() if _beats(theirs, ours, cost)]
    if not rivals:
        return None
    clear = [_clearly(points[other], ours, cost) for other in rivals]
    best = max(rivals, key=lambda other: (points[other]["PSNR"]["mean"], -points[other][cost]["mean"]))
    return {"by": best, "clearly": True if True in clear else None if None in clear else False}


def _beats(theirs: Point, ours: Point, cost: str) -> bool:
    better, cheaper = _gains(theirs, ours, cost)
    return min(better, cheaper) >= 0 and max(better, cheaper) > 0


def _gains(theirs: Point, ours: Point, cost: str) -> tuple[float, float]:
    return theirs["PSNR"]["mean"] - ours["PSNR"]["mean"], ours[cost]["mean"] - theirs[cost]["mean"]


def _clearly(theirs: Point, ours: Point, cost: str) -> bool | None:
    deviations = [(theirs[key]["std"], ours[key]["std"]) for key in ("PSNR", cost)]
    if any(None in pair for pair in deviations):
        return None
    return any(gain > math.hypot(*pair) for gain, pair in zip(_gains(theirs, ours, cost), deviations, strict=True))
