"""Tables of the report: report.json's numbers as text, for the pages and the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from applications.evaluation.comparison import COMPARED, OTHER_SCORES
from splatting.records.renders import SCORES

QUANTITIES = {  # heading and digits
    **{"PSNR": ("PSNR (dB)", 2), "SSIM": ("SSIM", 4), "LPIPS": ("LPIPS", 4), "DISTS": ("DISTS", 4)},
    "STLPIPS": ("ST-LPIPS", 4),
    **{
        "seconds": ("training (s)", 1),
        "joules": ("GPU energy (J)", 0),
        "process_seconds": ("process (s)", 1),
        "cpu_seconds": ("CPU (s)", 1),
        "gaussians": ("Gaussians trained", 0),
    },
    **{name: (f"PSNR, {name[5:].replace('_', ' ')} (dB)", 2) for name in OTHER_SCORES},
    **{"ply_mb": ("PLY (MB)", 1), "peak_memory_mib": ("peak memory (MiB)", 0), "render_ms": ("render (ms)", 2)},
}
_LAST_OF_PEER = {  # heading, and digits, of a column of a peer's curve
    **{"iteration": ("iteration", 0), "seconds": ("seconds", 1), "test_psnr": ("PSNR (dB)", 2)},
    **{"test_ssim": ("SSIM", 4), "gaussians": ("Gaussians", 0)},
}


MAIN = (*SCORES, *OTHER_SCORES, "seconds", "joules", "gaussians", "ply_mb")  # what a report shows first
REST = tuple(name for name in QUANTITIES if name not in MAIN)


class Table(NamedTuple):
    """A table of texts. title: what is said above it; empty: nothing."""

    header: list[str]
    rows: list[list[str]]
    title: str = ""


def format_number(value: float | None, digits: int) -> str:
    """Format a number for a cell; None becomes -."""
    return "-" if value is None else f"{value:,.{digits}f}"


def format_spread(spread: Mapping[str, Any], digits: int) -> str:
    """Format mean and standard deviation of a `comparison.spread`."""
    return format_number(spread["mean"], digits) + ("" if spread["std"] is None else f" ± {spread['std']:,.{digits}f}")


def make_table(columns: Mapping[str, Callable[[Any], str]], items: Sequence[Any], title: str = "") -> Table:
    """Make a table with a row for each item. columns: heading and text of a cell."""
    return Table(list(columns), [[text(item) for text in columns.values()] for item in items], title)


def _format_iteration(row: Mapping[str, Any]) -> str:
    several = row.get("iterations", [])  # reports of older versions lack it
    return f"{several[0]:,} to {several[-1]:,}" if len(several) > 1 else format_number(row["iteration"], 0)


def make_result_tables(rows: Sequence[Mapping[str, Any]], names: Sequence[str] = tuple(QUANTITIES)) -> list[Table]:
    """Tables of report.json's `summary` and `means`: rows that can be compared, and those that stand apart.

    names: the QUANTITIES to show.
    """
    apart = [row for row in rows if row.get("apart")]  # reports of older versions lack it
    comparable = [row for row in rows if not row.get("apart")]
    why = {f"{row['scene']}, {row['config'] or '-'}: {row.get('why_apart') or 'not known'}": None for row in apart}
    title = f"Scored on other ground truth, so not to be compared with other rows. {'. '.join(why)}."
    return [_make_results_table(part, names, said) for part, said in ((comparable, ""), (apart, title)) if part]


def _make_results_table(rows: Sequence[Mapping[str, Any]], names: Sequence[str], title: str) -> Table:
    """A table without columns that are empty, but for PSNR and SSIM."""
    columns = {"scene": lambda row: row["scene"]}
    if any(row["config"] for row in rows):
        columns["options"] = lambda row: row["config"] or "-"
    columns["iteration"] = _format_iteration
    for name in names:
        head, digits = QUANTITIES[name]
        if name in SCORES[:2] or any(row[name]["mean"] is not None for row in rows if name in row):
            columns[head] = lambda row, name=name, digits=digits: format_spread(row[name], digits)
    if any(row["seeds"] != [None] for row in rows):
        columns["seeds"] = lambda row: _format_seeds(row["seeds"])
    return make_table(columns, rows, title)


def _format_seeds(seeds: Sequence[int | None]) -> str:
    return " ".join("-" if seed is None else str(seed) for seed in seeds)


def make_peers_table(peers: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the last points of other programs' curves."""
    columns = {
        "scene": lambda peer: peer["scene"],
        "program": lambda peer: peer["name"],
        "points": lambda peer: str(len(peer["curve"])),
    }
    for name, (head, digits) in _LAST_OF_PEER.items():
        columns[head] = lambda peer, name=name, digits=digits: format_number(peer["curve"][-1][name], digits)
    return make_table({**columns, "file": lambda peer: peer["file"]}, peers)


def make_published_table(compared: Sequence[Mapping[str, Any]]) -> Table:
    """Table of report.json's `published`."""
    columns = {
        "scene": lambda row: row["scene"],
        "table": lambda row: row["table"],
        "its GPU": lambda row: row["hardware"].removesuffix(" GPU"),
        "iteration": lambda row: format_number(row["iteration"], 0),
    }
    for name in COMPARED:
        head, digits = QUANTITIES[name]
        compares = name != "seconds"  # on different machines
        columns[f"{head}: ours, published" + compares * ", difference"] = (
            lambda row, name=name, digits=digits, compares=compares: _format_beside(
                row["numbers"].get(name), digits, compares
            )
        )
    columns |= {"our photos": lambda row: row["photos"], "our options": _format_other_options}
    return make_table(columns, compared)


def _format_other_options(row: Mapping[str, Any]) -> str:
    added = row["other_options"]
    options = "not known" if added is None else " ".join(added) or "the table's"
    return f"{row['config']}: {options}" if row["config"] else options


def _format_beside(values: Mapping[str, float] | None, digits: int, compares: bool) -> str:
    if values is None:
        return "-"
    both = f"{format_number(values['ours'], digits)}, {format_number(values['published'], digits)}"
    return f"{both}, {values['difference']:+,.{digits}f}" if compares else both


def make_gains_table(found: Mapping[str, Any]) -> Table:
    """Table of a scene's gains: a row for each option set but the one that others are compared with."""
    columns = {
        "options": lambda one: one[0],
        "seeds": lambda one: format_number(one[1]["seeds"], 0),
        "gain (dB)": lambda one: f"{one[1]['mean']:+.2f} ± {one[1]['half']:.2f}",
        "verdict": lambda one: one[1]["verdict"],
    }
    return make_table(columns, list(found["sets"].items()))


def make_runs_table(runs: Sequence[Mapping[str, Any]]) -> Table:
    """Table of what each run was given."""
    columns = {
        "model": lambda run: run["model"],
        "source": lambda run: run["source"] or "-",
        "photos": lambda run: run["photos"] or "not known",
        "train views": lambda run: format_number(run["views"]["train"], 0),
        "test views": lambda run: format_number(run["views"]["test"], 0),
        "split": lambda run: run["split"] or "not known",
        "test sizes": lambda run: " ".join(f"{width}x{height}" for width, height in run["test_sizes"]) or "-",
        "ground truth": lambda run: (run["ground_truth_sha256"] or "-")[:12],
        "train.py options": lambda run: " ".join(run["options"] or ["not known"]),
    }
    return make_table(columns, runs)
