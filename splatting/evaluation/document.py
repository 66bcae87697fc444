"""Content of the report as plain data: sections of blocks, which `pages` renders as HTML and as Markdown.

A section is a title and its blocks. A block is a paragraph (str) or a dictionary, whose first key tells its kind:
`rows` of texts with their `header`, `picture` (path of a PNG), `quote` (lines of a program), `link` (path beside the
report), or `photo`, `render` and `error` (JPEGs) of a test view. Pictures, links and views have a `text`.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from splatting.evaluation.machine import one_line
from splatting.evaluation.option_sets import COSTS
from splatting.evaluation.published import COMPARED, published_tables
from splatting.evaluation.summary import SCORES

Block = str | dict[str, Any]
Blocks = Mapping[str, Sequence[Block]]  # by scene
Section = tuple[str, list[Block]]

QUANTITIES = {  # heading and digits
    **{"PSNR": ("PSNR (dB)", 2), "SSIM": ("SSIM", 4), "LPIPS": ("LPIPS", 4), "seconds": ("training (s)", 1)},
    **{"process_seconds": ("process (s)", 1), "cpu_seconds": ("CPU (s)", 1), "gaussians": ("Gaussians", 0)},
    **{"ply_mb": ("PLY (MB)", 1), "peak_memory_mib": ("peak memory (MiB)", 0), "render_ms": ("render (ms)", 2)},
}
_LAST_OF_PEER = {"iteration": 0, "seconds": 1, "test_psnr": 2, "test_ssim": 4, "gaussians": 0}
_REACHED_NOTE = (
    "Each cell has the seconds of training until the test PSNR was first reached, the Gaussians at that time and the "
    "megabytes (10^6 bytes) of a PLY with as many, and the seconds as a part of those of the other set named. "
    "They come from the curves: scores of all test views during training, on unrounded images. Between two scorings, "
    "PSNR is taken as linear in the logarithm of the seconds; if the seconds more than double between them, and before "
    "the first one, the scoring that reaches the PSNR counts. Gaussians are those of that scoring, and a PLY has as "
    "many bytes for each as the one at the end."
)
_REACHED_SEEDS_NOTE = (
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
_CHEAPEST_NOTE = (
    "Each row has the option set that reaches its test PSNR in the fewest seconds of training and the one with the "
    "fewest Gaussians at that PSNR or better. Both come from the curves: scores during training, on unrounded images. "
    "Between two points, PSNR is taken as linear in the logarithm of time. With several seeds, all must reach the "
    "PSNR, and their mean counts; ± is the sample standard deviation."
)
_PEERS_NOTE = (
    "The last point of curves that other programs measured, as their files give it. Whether their seconds leave out "
    "scoring and saving, and whether they scored the same pixels, the files do not say. So these curves are drawn "
    "beside ours, but they count in no ranking."
)


def number(value: float | None, digits: int) -> str:
    """Format a number for a cell; None becomes -."""
    return "-" if value is None else f"{value:,.{digits}f}"


def spread_cell(spread: Mapping[str, Any], digits: int) -> str:
    """Format mean and standard deviation of a `summary.spread`."""
    return number(spread["mean"], digits) + ("" if spread["std"] is None else f" ± {spread['std']:,.{digits}f}")


def table(columns: Mapping[str, Callable[[Any], str]], items: Sequence[Any]) -> dict[str, Any]:
    """Make a table with a row for each item. columns: heading and text of a cell."""
    return {"rows": [[text(item) for text in columns.values()] for item in items], "header": list(columns)}


def run_title(run: Mapping[str, Any]) -> str:
    """Name a run by scene, option set and seed."""
    seed = None if run["seed"] is None else f"seed {run['seed']}"
    return ", ".join(part for part in (run["scene"], run["config"], seed) if part)


def document(report: Mapping[str, Any], figures: Blocks, fronts: Blocks) -> list[Section]:
    """Return the sections of the report. figures: those of each scene and its comparisons; fronts: of its fronts."""
    sections = [
        ("Failed", _failures(report)),
        ("Results", _results(report)),
        ("Other programs", _peers(report)),
        ("Beside published numbers", _published(report)),
        ("Seconds to reach a test PSNR", _reached(report)),
        ("Pareto fronts of option sets", _fronts(report, fronts)),
        ("Cheapest option set for a given error", _cheapest(report)),
        *((scene, [*_scene(report, scene), *figures.get(scene, ())]) for scene in scenes_of(report)),
        ("What training said at its end", [f"{run_title(run)}: {'. '.join(run['lines'])}." for run in report["runs"]
                                           if run["lines"]]),
        ("What was run", _manifest(report)),
    ]  # fmt: skip
    return [(title, blocks) for title, blocks in sections if blocks]


def scenes_of(report: Mapping[str, Any]) -> list[str]:
    """List the scenes of a report in the order of its runs."""
    return list(dict.fromkeys(run["scene"] for run in report["runs"]))


def _failures(report: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    for run in report["runs"]:
        if failure := run["failure"]:
            command = [" ".join(failure["command"])] if failure["command"] else []
            blocks += [f"{run_title(run)}: failed in {failure['stage']}", {"quote": [*command, *failure["lines"]]}]
    return blocks


def results_table(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Make a table of report.json's `summary`, without columns of times, sizes and memory that are empty."""
    columns = {"scene": lambda row: row["scene"]}
    if any(row["config"] for row in rows):
        columns["options"] = lambda row: row["config"] or "-"
    columns |= {"iteration": _iteration, "seeds": _seeds}
    for name, (head, digits) in QUANTITIES.items():
        if name in SCORES or any(row[name]["mean"] is not None for row in rows if name in row):
            columns[head] = lambda row, name=name, digits=digits: spread_cell(row[name], digits)
    return table(columns, rows)


def _iteration(row: Mapping[str, Any]) -> str:
    several = row.get("iterations", [])  # reports of older versions lack it
    return f"{several[0]:,} to {several[-1]:,}" if len(several) > 1 else f"{row['iteration']:,}"


def _seeds(row: Mapping[str, Any]) -> str:
    return " ".join(map(str, row["seeds"])) if row["seeds"] != [None] else "-"


def result_blocks(rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Return the table of `summary`, and one of the rows that stand apart from the others."""
    apart = [row for row in rows if row.get("apart")]  # reports of older versions lack it
    if not apart:
        return [results_table(rows)]
    comparable = [row for row in rows if not row["apart"]]
    why = {f"{row['scene']}, {row['config'] or '-'}: {row.get('why_apart') or 'not known'}": None for row in apart}
    title = f"Scored on other ground truth, so not to be compared with other rows. {'. '.join(why)}."
    return [*([results_table(comparable)] if comparable else []), title, results_table(apart)]


def _results(report: Mapping[str, Any]) -> list[Block]:
    rows = report["summary"]
    blocks: list[Block] = result_blocks(rows) if rows else ["Nothing was scored."]
    if any(row["PSNR"]["std"] is not None for row in rows):
        blocks.append("Cells are mean ± sample standard deviation over the seeds.")
    elif any(row["seconds"]["mean"] is not None for row in rows):
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
        columns = {
            "data set": lambda mean: mean["group"],
            "options": lambda mean: mean["config"] or "-",
            "iteration": lambda mean: number(mean["iteration"], 0),
        }
        for name, (head, digits) in QUANTITIES.items():
            columns[head] = lambda mean, name=name, digits=digits: number(mean[name], digits)
        blocks.append(table(columns, means))
    return [*blocks, *report["warnings"]]


def _peers(report: Mapping[str, Any]) -> list[Block]:
    if not report["peers"]:
        return []
    heads = ["scene", "program", "points", "iteration", "seconds", "PSNR (dB)", "SSIM", "Gaussians", "file"]
    cells = []
    for peer in report["peers"]:
        last = [number(peer["curve"][-1][name], digits) for name, digits in _LAST_OF_PEER.items()]
        cells.append([peer["scene"], peer["name"], str(len(peer["curve"])), *last, peer["file"]])
    return [{"rows": cells, "header": heads}, _PEERS_NOTE]


def _published(report: Mapping[str, Any]) -> list[Block]:
    if not report["published"]:
        return []
    columns = {
        "scene": lambda row: row["scene"],
        "options": _other_options,
        "iteration": lambda row: f"{row['iteration']:,}",
        "table": lambda row: row["table"],
    }
    for name in COMPARED:
        head = f"{QUANTITIES[name][0]}: ours, published, difference"
        columns[head] = lambda row, name=name: _beside(row["numbers"].get(name), QUANTITIES[name][1])
    named = {row["table"] for row in report["published"]}
    notes = [f"{known['name']} ({known['hardware']}): {known['source']}; {known['note']}."
             for known in published_tables() if known["name"] in named]  # fmt: skip
    return [table(columns, report["published"]), *notes]


def _other_options(row: Mapping[str, Any]) -> str:
    added = row["other_options"]
    options = "not known" if added is None else " ".join(added) or "the table's"
    return f"{row['config']}: {options}" if row["config"] else options


def _beside(values: Mapping[str, float] | None, digits: int) -> str:
    if values is None:
        return "-"
    both = f"{number(values['ours'], digits)}, {number(values['published'], digits)}"
    return f"{both}, {values['difference']:+,.{digits}f}"


def _reached(report: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    several = False
    for scene, found in report["reached"].items():
        blocks += [f"{scene}, compared with {found['default']}:", reached_table(found)]
        several |= any(len(entry["final"]["values"]) > 1 for entry in found["sets"].values())
    return [*blocks, _REACHED_NOTE, *([_REACHED_SEEDS_NOTE] if several else [])] if blocks else []


def reached_table(found: Mapping[str, Any]) -> dict[str, Any]:
    """Make the table of a scene's `reached`: a row for each option set, a column for each level, highest first."""
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


def _fronts(report: Mapping[str, Any], figures: Blocks) -> list[Block]:
    blocks: list[Block] = []
    several = False
    for scene, found in report["fronts"].items():
        blocks += [scene, front_table(found), *figures.get(scene, ())]
        several |= any(len(point["PSNR"]["values"]) > 1 for point in found["sets"].values())
    return [*blocks, _FRONT_NOTE, *([_FRONT_SEEDS_NOTE] if several else [])] if blocks else []


def front_table(found: Mapping[str, Any]) -> dict[str, Any]:
    """Make the table of a scene: a row for each option set, with each cost and whether the set is on its front."""
    rows = []
    for name, point in found["sets"].items():
        row = [name, spread_cell(point["PSNR"], 2)]
        for cost in COSTS:
            row += [spread_cell(point[cost], QUANTITIES[cost][1]), _on_front(found["beaten"][cost][name])]
        rows.append(row)
    heads = [head for cost in COSTS for head in (QUANTITIES[cost][0], "on the front?")]
    return {"rows": rows, "header": ["options", "PSNR (dB)", *heads]}


def _on_front(beaten: Mapping[str, Any] | None) -> str:
    if beaten is None:
        return "yes"
    return f"no: {beaten['by']}" + (", within the spread" if beaten["clearly"] is False else "")


def cheapest_table(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Make a table of a scene's `cheapest` in report.json."""
    cells = []
    for row in rows:
        line = [f"{row['psnr']:.1f}"]
        for name, digits in (("seconds", 1), ("gaussians", 0)):
            line += [row[name]["config"] or "-", spread_cell({**row[name], "mean": row[name]["value"]}, digits)]
        cells.append(line)
    return {"rows": cells, "header": ["test PSNR (dB)", "first there", "seconds", "smallest", "Gaussians"]}


def _cheapest(report: Mapping[str, Any]) -> list[Block]:
    blocks = [block for scene, rows in report["cheapest"].items() for block in (scene, cheapest_table(rows))]
    return [*blocks, _CHEAPEST_NOTE] if blocks else []


def _scene(report: Mapping[str, Any], scene: str) -> list[Block]:
    blocks: list[Block] = []
    runs = [run for run in report["runs"] if run["scene"] == scene]
    for run in runs:
        if peak := run["peak"]:
            advice = f"; --iterations {peak['iteration']} would end there" if peak["shorter_ends_there"] else ""
            blocks.append(
                f"{run_title(run)}: the test views were best at iteration {peak['iteration']:,} "
                f"({peak['test_psnr']:.2f} dB) and lost {peak['lost']:.2f} dB until the end{advice}."
            )
    pages = [{"link": run["page"], "text": f"{run_title(run)}: the model in 3D"} for run in runs if run["page"]]
    return [*blocks, *pages]


def _manifest(report: Mapping[str, Any]) -> list[Block]:
    manifest = report["manifest"]
    machines = sorted({one_line(run["machine"]) for run in report["runs"] if run["machine"]})
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
    return [
        *(f"Command: {' '.join(words)}" for words in (*manifest["earlier_commands"], manifest["command"])),
        *(f"Trained on: {line}" for line in machines),
        f"Resize filter: {manifest['resize_filter']}",
        "Scores: " + "; ".join(f"{name}: {text}" for name, text in manifest["conventions"].items()),
        table(columns, report["runs"]),
        "Ground truth: the first digits of a digest of the test views' sizes, pixels and masks. Scores can be "
        "compared only if it is the same.",
    ]
