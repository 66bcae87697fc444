"""Tables of the report: report.json's numbers as text, for the pages, the terminal and docs/results/training.md."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from splatting.evaluation.comparison import COMPARED, COSTS, SCORES

QUANTITIES = {  # heading and digits
    **{"PSNR": ("PSNR (dB)", 2), "SSIM": ("SSIM", 4), "LPIPS": ("LPIPS", 4), "seconds": ("training (s)", 1)},
    **{"process_seconds": ("process (s)", 1), "cpu_seconds": ("CPU (s)", 1), "gaussians": ("Gaussians", 0)},
    **{"ply_mb": ("PLY (MB)", 1), "peak_memory_mib": ("peak memory (MiB)", 0), "render_ms": ("render (ms)", 2)},
}
_LAST_OF_PEER = {  # heading, and digits, of a column of a peer's curve
    **{"iteration": ("iteration", 0), "seconds": ("seconds", 1), "test_psnr": ("PSNR (dB)", 2)},
    **{"test_ssim": ("SSIM", 4), "gaussians": ("Gaussians", 0)},
}


class Table(NamedTuple):
    """A table of texts. title: what is said above it; empty: nothing."""

    header: list[str]
    rows: list[list[str]]
    title: str = ""


def number(value: float | None, digits: int) -> str:
    """Format a number for a cell; None becomes -."""
    return "-" if value is None else f"{value:,.{digits}f}"


def spread_cell(spread: Mapping[str, Any], digits: int) -> str:
    """Format mean and standard deviation of a `comparison.spread`."""
    return number(spread["mean"], digits) + ("" if spread["std"] is None else f" ± {spread['std']:,.{digits}f}")


def table(columns: Mapping[str, Callable[[Any], str]], items: Sequence[Any], title: str = "") -> Table:
    """Make a table with a row for each item. columns: heading and text of a cell."""
    return Table(list(columns), [[text(item) for text in columns.values()] for item in items], title)


def _iteration(row: Mapping[str, Any]) -> str:
    several = row.get("iterations", [])  # reports of older versions lack it
    return f"{several[0]:,} to {several[-1]:,}" if len(several) > 1 else number(row["iteration"], 0)


def result_tables(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Tables of report.json's `summary`: rows that can be compared, and those that stand apart."""
    apart = [row for row in rows if row.get("apart")]  # reports of older versions lack it
    comparable = [row for row in rows if not row.get("apart")]
    why = {f"{row['scene']}, {row['config'] or '-'}: {row.get('why_apart') or 'not known'}": None for row in apart}
    title = f"Scored on other ground truth, so not to be compared with other rows. {'. '.join(why)}."
    return [_results(part, said) for part, said in ((comparable, ""), (apart, title)) if part]


def _results(rows: Sequence[Mapping[str, Any]], title: str) -> Table:
    """A table without columns of times, sizes and memory that are empty."""
    columns = {"scene": lambda row: row["scene"]}
    if any(row["config"] for row in rows):
        columns["options"] = lambda row: row["config"] or "-"
    columns["iteration"] = _iteration
    columns["seeds"] = lambda row: " ".join(map(str, row["seeds"])) if row["seeds"] != [None] else "-"
    for name, (head, digits) in QUANTITIES.items():
        if name in SCORES or any(row[name]["mean"] is not None for row in rows if name in row):
            columns[head] = lambda row, name=name, digits=digits: spread_cell(row[name], digits)
    return table(columns, rows, title)


def means_table(means: Sequence[Mapping[str, Any]]) -> Table:
    """Table of report.json's `dataset_means`."""
    columns = {
        "data set": lambda mean: mean["group"],
        "options": lambda mean: mean["config"] or "-",
        "iteration": lambda mean: number(mean["iteration"], 0),
    }
    for name, (head, digits) in QUANTITIES.items():
        columns[head] = lambda mean, name=name, digits=digits: number(mean[name], digits)
    return table(columns, means)


def peers_table(peers: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the last points of other programs' curves."""
    columns = {
        "scene": lambda peer: peer["scene"],
        "program": lambda peer: peer["name"],
        "points": lambda peer: str(len(peer["curve"])),
    }
    for name, (head, digits) in _LAST_OF_PEER.items():
        columns[head] = lambda peer, name=name, digits=digits: number(peer["curve"][-1][name], digits)
    return table({**columns, "file": lambda peer: peer["file"]}, peers)


def published_table(compared: Sequence[Mapping[str, Any]]) -> Table:
    """Table of report.json's `published`."""
    columns = {
        "scene": lambda row: row["scene"],
        "options": _other_options,
        "iteration": lambda row: number(row["iteration"], 0),
        "table": lambda row: row["table"],
    }
    for name in COMPARED:
        head, digits = QUANTITIES[name]
        columns[f"{head}: ours, published, difference"] = lambda row, name=name, digits=digits: _beside(
            row["numbers"].get(name), digits
        )
    return table(columns, compared)


def _other_options(row: Mapping[str, Any]) -> str:
    added = row["other_options"]
    options = "not known" if added is None else " ".join(added) or "the table's"
    return f"{row['config']}: {options}" if row["config"] else options


def _beside(values: Mapping[str, float] | None, digits: int) -> str:
    if values is None:
        return "-"
    both = f"{number(values['ours'], digits)}, {number(values['published'], digits)}"
    return f"{both}, {values['difference']:+,.{digits}f}"


def reached_table(found: Mapping[str, Any]) -> Table:
    """Table of a scene's `reached`: a row for each option set, a column for each level, highest first."""
    columns = {"options": lambda one: one[0], "final PSNR (dB)": lambda one: spread_cell(one[1]["final"], 2)}
    for index, level in enumerate(found["levels"]):
        own = f" (final PSNR of {found['default']})" if level["of_default"] else ""
        head = f"{level['psnr']:.{2 if own else 1}f} dB{own}"
        columns[head] = lambda one, i=index: _cell(one[1]["cells"][i], found["default"], one[0] == found["default"])
    return table(columns, list(found["sets"].items()))


def _cell(cell: Mapping[str, Any], default: str, is_default: bool) -> str:
    """Format a cell of `reached`; that of another set is compared with the default's."""
    if not cell["reached"] and not cell["at_least"]:
        return "not reached"
    known = {key: [x for x in cell[key]["values"] if x is not None] for key in ("seconds", "gaussians", "mb")}
    means = {key: statistics.fmean(values) if values else None for key, values in known.items()}
    size = f" ({number(means['gaussians'], 0)}; {number(means['mb'], 1)} MB)"
    digits = 2 if means["seconds"] < 10 else 1
    if cell["seconds"]["mean"] is None:
        seeds = f"{cell['reached']} of {len(cell['seconds']['values'])} seeds"
        return f"{seeds}: {number(means['seconds'], digits)} s{size}"
    part = "" if is_default or cell["ratio"] is None else f", {cell['ratio']:.2f} of {default}'s"
    return f"{'≥ ' if cell['at_least'] else ''}{spread_cell(cell['seconds'], digits)} s{size}{part}"


def front_table(found: Mapping[str, Any]) -> Table:
    """Table of a scene's `fronts`: a row for each option set, with each cost and whether the set is on its front."""
    header, rows = ["options", "PSNR (dB)"], []
    for cost in COSTS:
        header += [QUANTITIES[cost][0], "on the front?"]
    for name, point in found["sets"].items():
        row = [name, spread_cell(point["PSNR"], 2)]
        for cost in COSTS:
            row += [spread_cell(point[cost], QUANTITIES[cost][1]), _on_front(found["beaten"][cost][name])]
        rows.append(row)
    return Table(header, rows)


def _on_front(beaten: Mapping[str, Any] | None) -> str:
    if beaten is None:
        return "yes"
    return f"no: {beaten['by']}" + (", within the spread" if beaten["clearly"] is False else "")


def cheapest_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Table of a scene's `cheapest`."""

    def cost(row: Mapping[str, Any], name: str, digits: int) -> str:
        return spread_cell({**row[name], "mean": row[name]["value"]}, digits)

    columns = {
        "test PSNR (dB)": lambda row: f"{row['psnr']:.1f}",
        "first there": lambda row: row["seconds"]["config"] or "-",
        "seconds": lambda row: cost(row, "seconds", 1),
        "smallest": lambda row: row["gaussians"]["config"] or "-",
        "Gaussians": lambda row: cost(row, "gaussians", 0),
    }
    return table(columns, rows)


def runs_table(runs: Sequence[Mapping[str, Any]]) -> Table:
    """Table of what each run was given."""
    columns = {
        "model": lambda run: run["model"],
        "source": lambda run: run["source"] or "-",
        "train views": lambda run: number(run["views"]["train"], 0),
        "test views": lambda run: number(run["views"]["test"], 0),
        "split": lambda run: run["split"] or "not known",
        "test sizes": lambda run: " ".join(f"{width}x{height}" for width, height in run["test_sizes"]) or "-",
        "ground truth": lambda run: (run["ground_truth_sha256"] or "-")[:12],
        "train.py options": lambda run: " ".join(run["options"] or ["not known"]),
    }
    return table(columns, runs)
