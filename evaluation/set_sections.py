"""Sections of the report about option sets: what each takes to reach a PSNR, and the Pareto fronts."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from evaluation.blocks import Block, Section, Table, number, spread_cell
from evaluation.fronts import COSTS

NOT_REACHED = "not reached"
_REACHED_NOTE = (
    "Each cell has the seconds of training until the test PSNR was first reached, the Gaussians at that time and the "
    "megabytes (10^6 bytes) of a PLY with as many, and the seconds as a part of those of the other set named. "
    "They come from the curves: scores of all test views during training, on unrounded images. Between two scorings, "
    "PSNR is taken as linear in the logarithm of the seconds; if the seconds more than double between them, and before "
    "the first one, the scoring that reaches the PSNR counts. Gaussians are those of that scoring, and a PLY has as "
    "many bytes for each as the one at the end."
)
_SEEDS_NOTE = (
    "Numbers are means ± sample standard deviations over the seeds. Where only some seeds reach the PSNR, their mean "
    "is given with their number, and no part. With \u2265, some seeds of the set that is compared with end below the "
    "mean of its own final PSNR; they count with all their seconds, which is too few, so the parts of the other sets "
    "are too large rather than too small."
)
_FRONT_NOTE = (
    "Where each option set ended: PSNR of metrics.py, seconds of training, Gaussians as trained, megabytes (10^6 "
    "bytes) of the saved PLY. A set is on a front if no other one is as good in both and better in one of them, by the "
    "means. Otherwise the set that beats it with the highest PSNR is named. Fronts have the ends of trainings alone; "
    "the fronts in the figure of error against time have all their points."
)
_FRONT_SEEDS_NOTE = (
    "Within the spread means: no set that beats it is better in PSNR or cost by more than the root of the sum of both "
    "squared standard deviations, so other seeds may turn the order."
)
_HEADS = {"seconds": "training (s)", "gaussians": "Gaussians", "ply_mb": "PLY (MB)"}
_DIGITS = {"seconds": 1, "gaussians": 0, "ply_mb": 1}


def reached_sections(report: Mapping[str, Any]) -> list[Section]:
    """Return the section of report.json's `reached`; none if it is empty."""
    blocks: list[Block] = []
    for scene, found in report["reached"].items():
        blocks += [f"{scene}, compared with {found['default']}:", reached_table(found)]
    if not blocks:
        return []
    cells = [
        cell for found in report["reached"].values() for entry in found["sets"].values() for cell in entry["cells"]
    ]
    several = any(len(cell["seconds"]["values"]) > 1 for cell in cells)
    return [Section("Seconds to reach a test PSNR", [*blocks, _REACHED_NOTE, *([_SEEDS_NOTE] if several else [])])]


def _entries(by_scene: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    return (entry for found in by_scene.values() for entry in found["sets"].values())


def reached_table(found: Mapping[str, Any]) -> Table:
    """Make the table of a scene: a row for each option set, a column for each level, highest first."""
    header = ["options", "final PSNR (dB)"]
    for level in found["levels"]:
        own = f" (final PSNR of {found['default']})" if level["of_default"] else ""
        header.append(f"{level['psnr']:.{2 if own else 1}f} dB{own}")
    rows = []
    for name, entry in found["sets"].items():
        other = None if name == found["default"] else found["default"]
        rows.append([name, spread_cell(entry["final"], 2), *(_cell(cell, other) for cell in entry["cells"])])
    return Table(header, rows)


def _cell(cell: Mapping[str, Any], other: str | None) -> str:
    """Format a cell. other: the set that this one is compared with, None for that set itself."""
    if not cell["reached"] and not cell["at_least"]:
        return NOT_REACHED
    seeds = len(cell["seconds"]["values"])
    means = {key: _mean_of_known(cell[key]["values"]) for key in ("seconds", "gaussians", "mb")}
    size = f" ({number(means['gaussians'], 0)}; {number(means['mb'], 1)} MB)"
    digits = 2 if means["seconds"] < 10 else 1
    if cell["seconds"]["mean"] is None:
        return f"{cell['reached']} of {seeds} seeds: {number(means['seconds'], digits)} s{size}"
    least = "\u2265 " if cell["at_least"] else ""
    part = f", {cell['ratio']:.2f} of {other}'s" if other and cell["ratio"] is not None else ""
    return f"{least}{spread_cell(cell['seconds'], digits)} s{size}{part}"


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def front_sections(report: Mapping[str, Any], figures: Mapping[str, Sequence[Block]]) -> list[Section]:
    """Return the section of report.json's `fronts`; none if it is empty. figures: of the fronts, by scene."""
    blocks: list[Block] = []
    for scene, found in report["fronts"].items():
        blocks += [scene, front_table(found), *figures.get(scene, ())]
    if not blocks:
        return []
    several = any(len(point["PSNR"]["values"]) > 1 for point in _entries(report["fronts"]))
    return [Section("Pareto fronts of option sets", [*blocks, _FRONT_NOTE, *([_FRONT_SEEDS_NOTE] if several else [])])]


def front_table(found: Mapping[str, Any]) -> Table:
    """Make the table of a scene: a row for each option set, with each cost and whether the set is on its front."""
    header = ["options", "PSNR (dB)"]
    for cost in COSTS:
        header += [_HEADS[cost], "on the front?"]
    rows = []
    for name, point in found["sets"].items():
        row = [name, spread_cell(point["PSNR"], 2)]
        for cost in COSTS:
            row += [spread_cell(point[cost], _DIGITS[cost]), _on_front(found["beaten"][cost][name])]
        rows.append(row)
    return Table(header, rows)


def _on_front(beaten: Mapping[str, Any] | None) -> str:
    if beaten is None:
        return "yes"
    return f"no: {beaten['by']}" + (", within the spread" if beaten["clearly"] is False else "")
