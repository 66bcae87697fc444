"""Files of the report: report.json, report.md, report.html, the figures and timing.txt."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.blocks import Block, Picture, run_title
from evaluation.comparisons import OF_A_REPORT, OF_A_RUN, comparisons
from evaluation.document import document
from evaluation.figures import draw_curves, draw_worst_views
from evaluation.front_figure import draw_fronts
from evaluation.fronts import fronts
from evaluation.ground_truth import stand_apart
from evaluation.html import to_html
from evaluation.markdown import to_markdown
from evaluation.option_sets import Sets, comparable_sets
from evaluation.published import compare
from evaluation.reached import reached
from evaluation.summary import dataset_means, summarise
from evaluation.tradeoff import cheapest
from records.error_curve import whole_sets
from utils.files.json_files import write_json
from utils.system_utils import UserError, atomic_write

TITLE = "3D Gaussian Splatting: evaluation"
SHORTEST = 10.0  # seconds of a process whose share of the processors says something
EVEN = 0.8  # share of the best that trainings get on a machine of their own
RESIZE_FILTER = "Pillow, bicubic, antialiased where it shrinks; 8-bit pictures"


def make_report(
    command: Sequence[str],
    runs: Sequence[dict[str, Any]],
    peers: Sequence[dict[str, Any]] = (),
    earlier_commands: Sequence[Sequence[str]] = (),
) -> dict[str, Any]:
    """Make the content of report.json.

    command: words of the command line; runs: results of `results.read_run`; peers: as `peers.peers_of` returns them;
    earlier_commands: those of calls that made other runs.
    """
    runs = stand_apart(runs)
    rows = summarise(runs)
    means = dataset_means(rows)
    return {
        "cheapest": _cheapest(runs),
        "dataset_means": means,
        "fronts": _of_scenes(runs, fronts),
        "manifest": {
            "command": list(command),
            "earlier_commands": [list(words) for words in earlier_commands if list(words) != list(command)],
            "conventions": next((run["conventions"] for run in runs if run["conventions"]), {}),
            "resize_filter": RESIZE_FILTER,
        },
        "peers": list(peers),
        "published": compare(runs, rows, means),
        "reached": _of_scenes(runs, reached),
        "runs": runs,
        "summary": rows,
        "warnings": _warnings(runs, rows),
    }


def _of_scenes(
    runs: Sequence[dict[str, Any]], of_sets: Callable[[Sets], dict[str, Any] | None]
) -> dict[str, dict[str, Any]]:
    """Return what a function says of the option sets of each scene that can be compared, if it says anything."""
    scenes = dict.fromkeys(run["scene"] for run in runs)
    return {scene: found for scene in scenes if (found := of_sets(comparable_sets(runs, scene)))}


def _cheapest(runs: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the `cheapest` table of each scene that has several option sets, without those that stand apart."""
    found = {}
    for scene in dict.fromkeys(run["scene"] for run in runs):
        curves: dict[str, list] = {}
        for run in runs:
            if run["scene"] == scene and run["config"] and not run["failure"] and not run["apart"]:
                curves.setdefault(run["config"], []).append(whole_sets(run["curve"]))
        if len(curves) > 1 and (rows := cheapest(curves)):
            found[scene] = rows
    return found


def _warnings(runs: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the reasons why numbers of this report cannot be compared."""
    lines = []
    for scene in dict.fromkeys(run["scene"] for run in runs):
        truths = {run["ground_truth_sha256"] for run in runs if run["scene"] == scene and run["ground_truth_sha256"]}
        if len(truths) > 1:
            apart = dict.fromkeys(run["config"] or "-" for run in runs if run["scene"] == scene and run["apart"])
            lines.append(
                f"{scene}: the runs were scored on different ground truth (size, split, background or masks), so their "
                "scores and curves cannot be compared. Left out of rankings and the Pareto front: "
                f"{', '.join(apart)}."
            )
        lines += _load_warning(scene, runs)
    for name in ("commit", "cpu", "gpu", "instruction_set", "threads"):
        values = {str(run["machine"].get(name)) for run in runs if run["machine"]}
        if len(values) > 1:
            lines.append(f"Trained with different {name}: {', '.join(sorted(values))}.")
    for row in rows:
        if row["failed_seeds"]:
            lines.append(f"{row['scene']} {row['config'] or ''}: means without failed seeds {row['failed_seeds']}.")
    return lines


def _load_warning(scene: str, runs: Sequence[dict[str, Any]]) -> list[str]:
    """Return a line if some trainings of a scene got much less of the processors than others."""
    shares = [
        run["cpu_seconds"] / run["wall_seconds"]
        for run in runs
        if run["scene"] == scene and run["cpu_seconds"] is not None and (run["wall_seconds"] or 0) >= SHORTEST
    ]
    if not shares or min(shares) > EVEN * max(shares):
        return []
    return [
        f"{scene}: the trainings got {min(shares):.2f} to {max(shares):.2f} CPU seconds a second. Where they got less, "
        "other programs used the machine, or the option set leaves processors idle; compare CPU seconds, too."
    ]


def write_report(report: Mapping[str, Any], output: Path) -> None:
    """Write all files of the report into `output`."""
    shown = len({(run["scene"], run["config"]) for run in report["runs"]})
    each = max(1, min(OF_A_RUN, OF_A_REPORT // max(1, shown)))
    pictures = {
        scene: _draw(
            output,
            scene,
            [run for run in report["runs"] if run["scene"] == scene],
            [peer for peer in report["peers"] if peer["scene"] == scene],
            each,
        )
        for scene in dict.fromkeys(run["scene"] for run in report["runs"])
    }
    drawn = {scene: _draw_fronts(output, scene, report) for scene in report["fronts"]}
    sections = document(report, pictures, drawn)
    texts = {
        "report.md": to_markdown(TITLE, sections, output),
        "report.html": to_html(TITLE, sections),
        "timing.txt": _timing(report["runs"]),
    }
    write_json(output / "report.json", report)
    for name, text in texts.items():
        with atomic_write(output / name) as temporary:
            # Names that are not UTF-8 have surrogates, which appear as numbers.
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _draw(
    output: Path, scene: str, runs: Sequence[dict[str, Any]], peers: Sequence[dict[str, Any]], each: int
) -> list[Block]:
    """Draw the figures of a scene: its curves, and views of each option set's first run that succeeded.

    These are its worst views, and as comparisons up to `each` views.
    """
    folder = output / "figures"
    pictures: list[Block] = []
    path = folder / f"{scene}_curves.png"
    try:
        if draw_curves(path, scene, runs, peers):
            pictures.append(Picture(path, f"{scene}: error of the test views against seconds of training"))
    except ImportError as error:
        print(f"warning: no figure of {scene}'s curves: matplotlib cannot be imported ({error})", file=sys.stderr)
    seen = set()
    for run in runs:
        if run["failure"] or run["config"] in seen:
            continue
        path = folder / f"{scene}{'_' + run['config'] if run['config'] else ''}_worst_views.png"
        try:
            drawn = draw_worst_views(path, run, output)
            views = comparisons(run, output, each) if drawn else []
        except UserError as error:
            print(f"warning: no pictures of the test views of {run_title(run)}: {error}", file=sys.stderr)
            continue
        if drawn:
            seen.add(run["config"])
            pictures += [Picture(path, f"{run_title(run)}: the test views with the lowest PSNR"), *views]
    return pictures


def _draw_fronts(output: Path, scene: str, report: Mapping[str, Any]) -> list[Block]:
    path = output / "figures" / f"{scene}_fronts.png"
    names = list(dict.fromkeys(run["config"] for run in report["runs"] if run["scene"] == scene))
    try:
        draw_fronts(path, scene, report["fronts"][scene], names)
    except ImportError as error:
        print(f"warning: no figure of {scene}'s fronts: matplotlib cannot be imported ({error})", file=sys.stderr)
        return []
    return [Picture(path, f"{scene}: PSNR of each option set at its end, against seconds, Gaussians and megabytes")]


def _timing(runs: Sequence[dict[str, Any]]) -> str:
    """Return the wall-clock minutes of train.py for each group of scenes, as text."""
    minutes: dict[str, float] = {}
    for run in runs:
        if run["wall_seconds"] is not None:
            minutes[run["group"]] = minutes.get(run["group"], 0.0) + run["wall_seconds"] / 60
    return "".join(f"{group}: {value:.2f} minutes\n" for group, value in minutes.items())
