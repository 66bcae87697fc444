"""Seconds that each option set takes to reach a test PSNR, and the Gaussians and the size of the PLY at that time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from evaluation.option_sets import Sets, default_set, final_psnr, scored
from evaluation.summary import spread
from evaluation.tradeoff import seconds_to_reach

DIGITS = 1e6  # of a PSNR in a curve
STEPS = (0, 1, 2, 4, 8)  # below the highest level, times the step


def round_levels(finals: Sequence[float]) -> list[float]:
    """Return a few round PSNRs (dB, descending) around the final ones of several sets.

    The first is the best final one, rounded down; the others lie below it, denser near it, down to the first that all
    sets end above. The step is 0.1, 0.5 or 1 dB, as the final ones differ by less than 0.5, less than 5, or more.
    """
    low, high = min(finals), max(finals)
    parts = 10 if high - low < 0.5 else 2 if high - low < 5 else 1  # of a dB
    levels = [(math.floor(high * parts) - step) / parts for step in STEPS]
    above = sum(level > low for level in levels)
    return levels[: above + 1]


def reached(sets: Sets) -> dict[str, Any] | None:
    """Return the table of a scene's sets; None if fewer than two have a curve to their end.

    default: the set that others are compared with. levels: `psnr`, and `of_default`: it is the mean final PSNR of that
    set. sets: by name `final` (spread of PSNR) and `cells`, one for each level (`_cell`), with `ratio`: its mean
    seconds as a part of the default's.
    """
    finals = {name: final_psnr(runs) for name, runs in sets.items()}
    sets = {name: runs for name, runs in sets.items() if finals[name]["mean"] is not None}
    if len(sets) < 2:
        return None
    default = default_set(sets)
    own = math.floor(finals[default]["mean"] * DIGITS) / DIGITS  # a mean of equal numbers may exceed them by a bit
    round_ones = [level for level in round_levels([finals[name]["mean"] for name in sets]) if abs(level - own) >= 0.005]
    levels = [{"psnr": level, "of_default": level == own} for level in sorted([*round_ones, own], reverse=True)]
    table = {
        name: {"final": finals[name], "cells": [_cell(runs, **level, is_default=name == default) for level in levels]}
        for name, runs in sets.items()
    }
    for entry in table.values():
        for cell, theirs in zip(entry["cells"], table[default]["cells"], strict=True):
            cell["ratio"] = _ratio(cell["seconds"]["mean"], theirs["seconds"]["mean"])
    return {"default": default, "levels": levels, "sets": table}


def _ratio(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs


def _cell(runs: Sequence[Mapping[str, Any]], psnr: float, of_default: bool, is_default: bool) -> dict[str, Any]:
    """Return what the seeds of a set take to reach a level: spreads of seconds, Gaussians and megabytes.

    Seeds that do not reach it have null, and so has the mean then. reached: the number of seeds that do; at_least:
    whether seconds are a lower bound. That is so only for the default's own final PSNR: a seed of it that ends below
    the mean counts with all its seconds, which is too few, so that no ratio flatters the others.
    """
    curves = [scored(run) for run in runs]
    rows = [next((row for row in curve if row["test_psnr"] >= psnr), None) for curve in curves]
    at_least = of_default and is_default and None in rows
    ends = [curve[-1] if at_least else None for curve in curves]
    seconds = [
        end["seconds"] if end and row is None else seconds_to_reach(curve, psnr)
        for curve, row, end in zip(curves, rows, ends, strict=True)
    ]
    counts = [(row or end or {}).get("gaussians") for row, end in zip(rows, ends, strict=True)]
    return {
        "at_least": at_least,
        "gaussians": spread(counts),
        "mb": spread(_megabytes(run, count) for run, count in zip(runs, counts, strict=True)),
        "reached": sum(row is not None for row in rows),
        "seconds": spread(seconds),
    }


def _megabytes(run: Mapping[str, Any], gaussians: float | None) -> float | None:
    """Return the size of a PLY of so many Gaussians, each with as many bytes as in the run's last one."""
    last = run["iterations"][str(run["final_iteration"])]
    saved = last["gaussians_saved"]
    return None if gaussians is None or not saved else gaussians * last["ply_mb"] / saved
