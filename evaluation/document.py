"""Content of the report, for both renderings: its sections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evaluation.blocks import Block, Link, Quote, Section, Table, number, run_title, spread_cell
from evaluation.machine import one_line
from evaluation.published import COMPARED, published_tables
from evaluation.set_sections import front_sections, reached_sections
from evaluation.summary import SCORES

_DIGITS = {
    **{"PSNR": 2, "SSIM": 4, "LPIPS": 4, "seconds": 1, "process_seconds": 1, "cpu_seconds": 1},
    **{"gaussians": 0, "ply_mb": 1, "peak_memory_mib": 0, "render_ms": 2},
}
_LAST_OF_PEER = {"iteration": 0, "seconds": 1, "test_psnr": 2, "test_ssim": 4, "gaussians": 0}
_HEADS = {
    "PSNR": "PSNR (dB)",
    "seconds": "training (s)",
    "process_seconds": "process (s)",
    "cpu_seconds": "CPU (s)",
    "gaussians": "Gaussians",
    "ply_mb": "PLY (MB)",
    "peak_memory_mib": "peak memory (MiB)",
    "render_ms": "render (ms)",
}


def results_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Make a table of report.json's `summary`, without columns of times, sizes and memory that are empty."""
    configs = any(row["config"] for row in rows)
    quantities = [
        name for name in _DIGITS
        if name in SCORES or any(row[name]["mean"] is not None for row in rows if name in row)
    ]  # fmt: skip
    header = ["scene", *(["options"] if configs else []), "iteration", "seeds"]
    header += [_HEADS.get(name, name) for name in quantities]
    cells = []
    for row in rows:
        label = [row["scene"], *([row["config"] or "-"] if configs else [])]
        seeds = " ".join(map(str, row["seeds"])) if row["seeds"] != [None] else "-"
        cells.append([*label, _iteration(row), seeds, *(spread_cell(row[name], _DIGITS[name]) for name in quantities)])
    return Table(header, cells)


def _iteration(row: Mapping[str, Any]) -> str:
    several = row.get("iterations", [])  # reports of older versions lack it
    return f"{several[0]:,} to {several[-1]:,}" if len(several) > 1 else f"{row['iteration']:,}"


def document(
    report: Mapping[str, Any], figures: Mapping[str, Sequence[Block]], fronts: Mapping[str, Sequence[Block]]
) -> list[Section]:
    """Return the sections of the report. figures: those of each scene and its comparisons; fronts: of its fronts."""
    return [
        *_failures(report),
        _results(report),
        *_peers(report),
        *_published(report),
        *reached_sections(report),
        *front_sections(report, fronts),
        *_cheapest(report),
        *_scenes(report, figures),
        *_closing(report),
        _manifest(report),
    ]


def _failures(report: Mapping[str, Any]) -> list[Section]:
    blocks: list[Block] = []
    for run in report["runs"]:
        if failure := run["failure"]:
            blocks.append(f"{run_title(run)}: failed in {failure['stage']}")
            blocks.append(
                Quote([" ".join(failure["command"]), *failure["lines"]] if failure["command"] else failure["lines"])
            )
    return [Section("Failed", blocks)] if blocks else []


def result_blocks(rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Return the table of `summary`, and one of the rows that stand apart from the others."""
    apart = [row for row in rows if row.get("apart")]  # reports of older versions lack it
    if not apart:
        return [results_table(rows)]
    comparable = [row for row in rows if not row["apart"]]
    why = {f"{row['scene']}, {row['config'] or '-'}: {row.get('why_apart') or 'not known'}": None for row in apart}
    title = f"Scored on other ground truth, so not to be compared with other rows. {'. '.join(why)}."
    return [*([results_table(comparable)] if comparable else []), title, results_table(apart)]


def _results(report: Mapping[str, Any]) -> Section:
    rows = report["summary"]
    blocks: list[Block] = result_blocks(rows) if rows else ["Nothing was scored."]
    if any(row["PSNR"]["std"] is not None for row in rows):
        blocks.append("Cells are mean ± sample standard deviation over the seeds.")
    elif rows and any(row["seconds"]["mean"] is not None for row in rows):
        blocks.append("Each number is of one training, so nothing is known of the spread; --seeds would show it.")
    if any(row["cpu_seconds"]["mean"] is not None for row in rows):
        blocks.append(
            "Process and CPU are seconds of the whole of train.py: on the clock, and of all its threads together. "
            "Where the clock ran longer for the same CPU seconds, other programs used the machine."
        )
    if any(row["gaussians"]["mean"] != row["gaussians_saved"]["mean"] for row in rows):
        blocks.append(
            "Gaussians are counted as trained, as in published tables. The saved models lack those that no training "
            "view depends on (gaussians_saved in report.json)."
        )
    if any(row.get("open_ended") for row in rows):
        blocks.append("Trainings with a time budget or a score to reach end by themselves: their row is of their end.")
    if rows and all(row["LPIPS"]["mean"] is None for row in rows):
        blocks.append(
            "LPIPS is missing: metrics.py found no weights of its network, and its message says where to put them."
        )
    if unfinished := [run_title(run) for run in report["runs"] if not run["finished"] and not run["failure"]]:
        blocks.append(f"Not finished: {'; '.join(unfinished)}.")
    if means := report["dataset_means"]:
        header = ["data set", "options", "iteration", *(_HEADS.get(name, name) for name in _DIGITS)]
        cells = [
            [mean["group"], mean["config"] or "-", number(mean["iteration"], 0)]
            + [number(mean[name], digits) for name, digits in _DIGITS.items()]
            for mean in means
        ]
        blocks.append(Table(header, cells))
    blocks += report["warnings"]
    return Section("Results", blocks)


def _published(report: Mapping[str, Any]) -> list[Section]:
    if not report["published"]:
        return []
    header = ["scene", "options", "iteration", "table"]
    header += [f"{_HEADS.get(name, name)}: ours, published, difference" for name in COMPARED]
    cells = []
    for row in report["published"]:
        added = row["other_options"]
        options = "not known" if added is None else " ".join(added) or "the table's"
        line = [
            row["scene"],
            f"{row['config']}: {options}" if row["config"] else options,
            f"{row['iteration']:,}",
            row["table"],
        ]
        for name in COMPARED:
            values = row["numbers"].get(name)
            digits = _DIGITS[name]
            if values is None:
                line.append("-")
                continue
            both = f"{number(values['ours'], digits)}, {number(values['published'], digits)}"
            line.append(f"{both}, {values['difference']:+,.{digits}f}")
        cells.append(line)
    named = {row["table"] for row in report["published"]}
    notes = [f"{table['name']} ({table['hardware']}): {table['source']}; {table['note']}."
             for table in published_tables() if table["name"] in named]  # fmt: skip
    return [Section("Beside published numbers", [Table(header, cells), *notes])]


def cheapest_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Make a table of a scene's `cheapest` in report.json."""
    cells = []
    for row in rows:
        line = [f"{row['psnr']:.1f}"]
        for name, digits in (("seconds", 1), ("gaussians", 0)):
            line += [row[name]["config"] or "-", spread_cell({**row[name], "mean": row[name]["value"]}, digits)]
        cells.append(line)
    return Table(["test PSNR (dB)", "first there", "seconds", "smallest", "Gaussians"], cells)


def _cheapest(report: Mapping[str, Any]) -> list[Section]:
    blocks: list[Block] = []
    for scene, rows in report["cheapest"].items():
        blocks += [scene, cheapest_table(rows)]
    if not blocks:
        return []
    blocks.append(
        "Each row has the option set that reaches its test PSNR in the fewest seconds of training and the one with the "
        "fewest Gaussians at that PSNR or better. Both come from the curves: scores during training, on unrounded "
        "images. Between two points, PSNR is taken as linear in the logarithm of time. With several seeds, all must "
        "reach the PSNR, and their mean counts; ± is the sample standard deviation."
    )
    return [Section("Cheapest option set for a given error", blocks)]


def _peers(report: Mapping[str, Any]) -> list[Section]:
    if not report["peers"]:
        return []
    header = ["scene", "program", "points", "iteration", "seconds", "PSNR (dB)", "SSIM", "Gaussians", "file"]
    cells = []
    for peer in report["peers"]:
        last = peer["curve"][-1]
        numbers = [number(last[name], digits) for name, digits in _LAST_OF_PEER.items()]
        cells.append([peer["scene"], peer["name"], str(len(peer["curve"])), *numbers, peer["file"]])
    note = (
        "The last point of curves that other programs measured, as their files give it. Whether their seconds leave "
        "out scoring and saving, and whether they scored the same pixels, the files do not say. So these curves are "
        "drawn beside ours, but they count in no ranking."
    )
    return [Section("Other programs", [Table(header, cells), note])]


def _scenes(report: Mapping[str, Any], figures: Mapping[str, Sequence[Block]]) -> list[Section]:
    sections = []
    for scene in dict.fromkeys(run["scene"] for run in report["runs"]):
        blocks: list[Block] = []
        for run in report["runs"]:
            if run["scene"] == scene and (peak := run["peak"]):
                advice = f"; --iterations {peak['iteration']} would end there" if peak["shorter_ends_there"] else ""
                blocks.append(
                    f"{run_title(run)}: the test views were best at iteration {peak['iteration']:,} "
                    f"({peak['test_psnr']:.2f} dB) and lost {peak['lost']:.2f} dB until the end{advice}."
                )
        blocks += [
            Link(f"{run_title(run)}: the model in 3D", run["page"])
            for run in report["runs"]
            if run["scene"] == scene and run["page"]
        ]
        blocks += figures.get(scene, ())
        if blocks:
            sections.append(Section(scene, blocks))
    return sections


def _closing(report: Mapping[str, Any]) -> list[Section]:
    said = [f"{run_title(run)}: {'. '.join(run['lines'])}." for run in report["runs"] if run["lines"]]
    return [Section("What training said at its end", said)] if said else []


def _manifest(report: Mapping[str, Any]) -> Section:
    manifest = report["manifest"]
    header = ["model", "source", "train views", "test views", "split", "test sizes", "ground truth", "train.py options"]
    cells = []
    for run in report["runs"]:
        sizes = " ".join(f"{width}x{height}" for width, height in run["test_sizes"])
        views = [str(run["views"][name] if run["views"][name] is not None else "-") for name in ("train", "test")]
        digest = (run["ground_truth_sha256"] or "-")[:12]
        cells.append(
            [
                run["model"],
                run["source"] or "-",
                *views,
                run["split"] or "not known",
                sizes or "-",
                digest,
                " ".join(run["options"] or ["not known"]),
            ]
        )
    machines = sorted({one_line(run["machine"]) for run in report["runs"] if run["machine"]})
    return Section(
        "What was run",
        [
            *(f"Command: {' '.join(words)}" for words in (*manifest["earlier_commands"], manifest["command"])),
            *(f"Trained on: {line}" for line in machines),
            f"Resize filter: {manifest['resize_filter']}",
            "Scores: " + "; ".join(f"{name}: {text}" for name, text in manifest["conventions"].items()),
            Table(header, cells),
            "Ground truth: the first digits of a digest of the test views' sizes, pixels and masks. Scores can be "
            "compared only if it is the same.",
        ],
    )
