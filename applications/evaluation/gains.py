"""Gains of option sets: differences between trainings of the same seed, their intervals, and verdicts from these.

Runs of one seed share photos, order and start, so their difference varies less than each score does (common random
numbers). Intervals are Student's t at 95 %; p values of several scenes are corrected by Holm's procedure (1979).
A verdict says in words whether an option set gains, costs, makes no difference above some dB, or is not decided.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from applications.evaluation.comparison import Run, Sets, choose_default_set, find_comparable_sets, group_by

LEVEL = 0.05
SMALL = 0.2  # dB; an interval that ends below it says that there is no difference to speak of


def compute_gains(runs: Sequence[Run]) -> dict[str, Any]:
    """Compute the gains of each scene that has several option sets and seeds.

    By scene: `default`, the set that others are compared with, and `sets`, by name: `seeds`; `mean` and `half`, the
    mean gain in test PSNR (dB) and half of its interval, the smallest gain that so many seeds could have shown;
    `p`, corrected over the scenes; and `judge_gain`.
    """
    found: dict[str, dict[str, Any]] = {}
    for scene in group_by(runs, "scene"):
        sets = find_comparable_sets(runs, scene)
        if sets and (rows := _pair_seeds(sets)):
            found[scene] = {"default": choose_default_set(sets), "sets": rows}
    for name in dict.fromkeys(name for one in found.values() for name in one["sets"]):
        rows = [one["sets"][name] for one in found.values() if name in one["sets"]]
        for row, p in zip(rows, correct_holm([row["p"] for row in rows]), strict=True):
            row["p"] = p
            row["verdict"] = judge_gain(row)
    return found


def _pair_seeds(sets: Sets) -> dict[str, dict[str, Any]]:
    """Return, for each option set but the default, the interval of its gain in test PSNR (dB) over common seeds.

    sets: runs by option set; a set needs two seeds that the default set has, too.
    """
    default = choose_default_set(sets)
    theirs = _read_final_psnr(sets[default])
    rows = {}
    for name, runs in sets.items():
        own = _read_final_psnr(runs)
        seeds = [seed for seed in own if seed in theirs]
        if name != default and len(seeds) > 1:
            rows[name] = {"seeds": len(seeds)} | compute_interval([own[seed] - theirs[seed] for seed in seeds])
    return rows


def _read_final_psnr(runs: Sequence[Run]) -> dict[Any, float]:
    """Return the test PSNR (dB) at the end of each run, by seed; runs without a score are left out."""
    ends = ((run["seed"], run["iterations"].get(str(run["final_iteration"]), {}).get("PSNR")) for run in runs)
    return {seed: psnr for seed, psnr in ends if psnr is not None}


def compute_interval(differences: Sequence[float]) -> dict[str, float]:
    """Mean and half of the 95 % interval of at least two differences, and the p value of no difference."""
    from scipy import stats  # imported here: it takes long, and most programs need none

    count, mean = len(differences), statistics.fmean(differences)
    error = statistics.stdev(differences) / count**0.5
    half = float(stats.t.ppf(1 - LEVEL / 2, count - 1)) * error
    p = 2 * float(stats.t.sf(abs(mean) / error, count - 1)) if error else float(not mean)
    return {"mean": mean, "half": half, "p": p}


def correct_holm(p_values: Sequence[float]) -> list[float]:
    """P values corrected for their number, in their order (Holm 1979)."""
    corrected, least = [0.0] * len(p_values), 0.0
    for place, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        least = max(least, min(1.0, (len(p_values) - place) * p_values[index]))
        corrected[index] = least
    return corrected


def judge_gain(row: Mapping[str, float]) -> str:
    """Return a verdict in words by mean, interval and p value."""
    if row["p"] < LEVEL:
        return "gains" if row["mean"] > 0 else "costs"
    most = abs(row["mean"]) + row["half"]
    if not most:
        return "same scores"
    return f"no difference above {most:.2f} dB" if most <= SMALL else "not decided"
