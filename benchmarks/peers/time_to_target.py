"""Seconds of trainings until their test PSNR is near the best known of their scene, as distributions.

A run that never reaches a target takes infinitely long: it counts in every share and every median. Between two samples
of a curve nothing is interpolated: a target is reached at the first sample that has it, which may be late by the gap
before that sample.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

TARGETS = (0.5, 0.2, 0.1)  # dB below the best known

Steps = tuple[list[float], list[float]]  # where a share rises, and what it is from there on


class Curve(NamedTuple):
    """One training. points: seconds, ascending, and dB of all test views."""

    scene: str
    program: str
    run: str
    points: Sequence[tuple[float, float]]


def seconds_to_reach(points: Sequence[tuple[float, float]], level: float) -> float:
    """Seconds at the first point of `level` dB or more; infinite if there is none."""
    return next((seconds for seconds, psnr in points if psnr >= level), math.inf)


def best_known(curves: Sequence[Curve]) -> dict[str, tuple[float, str]]:
    """The highest PSNR of any point of a scene's curves, and the program that has it, the first of equals."""
    best: dict[str, tuple[float, str]] = {}
    for curve in curves:
        highest = max(psnr for _, psnr in curve.points)
        if curve.scene not in best or highest > best[curve.scene][0]:
            best[curve.scene] = highest, curve.program
    return best


def choose_comparable(curves: Sequence[Curve]) -> tuple[list[Curve], list[str]]:
    """The curves of programs that have all scenes, and the names of the other programs."""
    scenes: dict[str, set[str]] = {}
    for curve in curves:
        scenes.setdefault(curve.program, set()).add(curve.scene)
    every = set().union(*scenes.values())
    left_out = [program for program, there in scenes.items() if there != every]
    return [curve for curve in curves if curve.program not in left_out], left_out


def measure_times(
    curves: Sequence[Curve], best: Mapping[str, tuple[float, str]], target: float
) -> dict[str, list[float]]:
    """Return by program the seconds of each run until it is within `target` dB of the best known of its scene."""
    found: dict[str, list[float]] = {}
    for curve in curves:
        level = best[curve.scene][0] - target
        found.setdefault(curve.program, []).append(seconds_to_reach(curve.points, level))
    return found


def summarise_reached(seconds: Sequence[float]) -> tuple[int, float]:
    """Return the number of runs that reach a target, and the median seconds of all runs (infinite: half never do)."""
    return sum(map(math.isfinite, seconds)), statistics.median(seconds)


def ecdf(values: Sequence[float]) -> Steps:
    """The empirical distribution: distinct finite values, ascending, and the share of all values up to each."""
    counts = [(value, len(list(same))) for value, same in groupby(sorted(filter(math.isfinite, values)))]
    shares, total = [], 0
    for _, count in counts:
        total += count
        shares.append(total / len(values))
    return [value for value, _ in counts], shares


def performance_profile(
    curves: Sequence[Curve], best: Mapping[str, tuple[float, str]], targets: Sequence[float] = TARGETS
) -> dict[str, Steps]:
    """Return by program the share of problems that it solves within a factor of the least seconds of any program.

    Dolan and Moré 2002. A problem is a scene with a target; a program's seconds are the median of its runs there. A
    problem that a program does not solve counts, and one that no program solves counts for all of them. Each program
    must have all scenes (`choose_comparable`).
    """
    ratios: dict[str, list[float]] = {}
    for scene in dict.fromkeys(curve.scene for curve in curves):
        there = [curve for curve in curves if curve.scene == scene]
        for target in targets:
            seconds = {name: statistics.median(of) for name, of in measure_times(there, best, target).items()}
            least = min(seconds.values())
            for name, own in seconds.items():
                ratios.setdefault(name, []).append(own / least if math.isfinite(own) else math.inf)
    return {name: ecdf(values) for name, values in ratios.items()}
