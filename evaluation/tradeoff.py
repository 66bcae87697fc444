"""Error against time across option sets: the Pareto front, and the cheapest option set for a given error."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from records.error_curve import Row

DROPS = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0)  # dB below the best; dense where the last tenths get expensive
WIDEST_STEP = 2.0  # largest ratio of the seconds of two points to interpolate between; a wider gap tells too little

Curves = Mapping[str, Sequence[Sequence[Row]]]  # option set -> a curve for each seed


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (cost, error) that no other beats in both, by ascending cost.

    Of equal points it keeps the first.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if not front or points[index][1] < points[front[-1]][1]:
            front.append(index)
    return front


def seconds_to_reach(curve: Sequence[Row], level: float) -> float | None:
    """Return the seconds of training until the test PSNR first reaches `level` (dB); None if it never does.

    Between scored iterations, PSNR is taken as linear in the logarithm of the seconds. If the seconds more than double
    between them, and for the first one, the time of the iteration that reaches `level` counts instead.
    """
    before: Row | None = None
    for row in curve:
        if row["test_psnr"] is None:
            continue
        if row["test_psnr"] >= level:
            if before is None or before["seconds"] <= 0 or row["seconds"] > WIDEST_STEP * before["seconds"]:
                return row["seconds"]
            part = (level - before["test_psnr"]) / (row["test_psnr"] - before["test_psnr"])
            return math.exp((1 - part) * math.log(before["seconds"]) + part * math.log(row["seconds"]))
        before = row
    return None


def gaussians_to_reach(curve: Sequence[Row], level: float) -> float | None:
    """Return the least number of Gaussians of a scored iteration that reaches `level` (dB); None if none does."""
    counts = [row["gaussians"] for row in curve if row["test_psnr"] is not None and row["test_psnr"] >= level]
    return min((count for count in counts if count is not None), default=None)


def levels(curves: Curves) -> list[float]:
    """Return the PSNRs (dB, descending) of the table.

    The first is the best that all seeds of some option set reach, rounded down to a tenth. The others are DROPS below
    it, down to the lowest PSNR at which a curve starts.
    """
    top = max((min(_best(curve) for curve in seeds) for seeds in curves.values() if seeds), default=-math.inf)
    if not math.isfinite(top):
        return []
    firsts = [next((row["test_psnr"] for row in curve if row["test_psnr"] is not None), top) for curve in _all(curves)]
    tenths = math.floor(top * 10)
    return [level for drop in DROPS if (level := (tenths - round(10 * drop)) / 10) > min(firsts)]


def _all(curves: Curves) -> list[Sequence[Row]]:
    return [curve for seeds in curves.values() for curve in seeds]


def _best(curve: Sequence[Row]) -> float:
    return max((row["test_psnr"] for row in curve if row["test_psnr"] is not None), default=-math.inf)


def cheapest(curves: Curves) -> list[dict[str, Any]]:
    """Return, for each level, the option set that reaches it in the fewest seconds, and that with fewest Gaussians.

    With several seeds, all must reach the level, and their mean counts; std is their sample standard deviation.
    """
    rows = []
    for level in levels(curves):
        row: dict[str, Any] = {"psnr": level}
        for name, measure in (("seconds", seconds_to_reach), ("gaussians", gaussians_to_reach)):
            costs, spreads = {}, {}
            for config, seeds in curves.items():
                values = [measure(curve, level) for curve in seeds]
                if values and None not in values:
                    costs[config] = statistics.fmean(values)
                    spreads[config] = statistics.stdev(values) if len(values) > 1 else None
            best = min(costs, key=costs.__getitem__, default=None)
            row[name] = {"all": costs, "config": best, "std": spreads.get(best), "value": costs.get(best)}
        rows.append(row)
    return rows
