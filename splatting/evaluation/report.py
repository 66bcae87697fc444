"""Files of the report: report.json, report.md, report.html, the figures and timing.txt."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from splatting.evaluation.contact_sheet import comparisons, draw_worst_views
from splatting.evaluation.document import Block, document, run_title, scenes_of
from splatting.evaluation.figures import draw_curves, draw_fronts
from splatting.evaluation.option_sets import Sets, cheapest, comparable_sets, fronts, reached, stand_apart
from splatting.evaluation.pages import to_html, to_markdown
from splatting.evaluation.published import compare
from splatting.evaluation.summary import dataset_means, summarise
from splatting.files.json_files import write_json
from utils.system_utils import UserError, atomic_write

TITLE = "3D Gaussian Splatting: evaluation"
SHORTEST = 10.0  # seconds of a process whose share of the processors says something
EVEN = 0.8  # share of the best that trainings get on a machine of their own
OF_A_RUN, OF_A_REPORT = 24, 96  # test views at most in the HTML file, at about 0.1 MB each
RESIZE_FILTER = "Pillow, bicubic, antialiased where it shrinks; 8-bit pictures"

Run = dict[str, Any]


def make_report(
    command: Sequence[str],
    runs: Sequence[Run],
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
        "cheapest": _of_scenes(runs, cheapest),
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


def _by_scene(runs: Sequence[Run]) -> dict[str, list[Run]]:
    scenes: dict[str, list[Run]] = {}
    for run in runs:
        scenes.setdefault(run["scene"], []).append(run)
    return scenes


def _of_scenes(runs: Sequence[Run], of_sets: Callable[[Sets], Any]) -> dict[str, Any]:
    """Return what a function says of the option sets of each scene that can be compared, if it says anything."""
    return {scene: found for scene in _by_scene(runs) if (found := of_sets(comparable_sets(runs, scene)))}


def _warnings(runs: Sequence[Run], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the reasons why numbers of this report cannot be compared."""
    lines = []
    for scene, members in _by_scene(runs).items():
        if len({run["ground_truth_sha256"] for run in members} - {None}) > 1:
            apart = dict.fromkeys(run["config"] or "-" for run in members if run["apart"])
            lines.append(
                f"{scene}: the runs were scored on different ground truth (size, split, background or masks), so their "
                "scores and curves cannot be compared. Left out of rankings and the Pareto front: "
                f"{', '.join(apart)}."
            )
        shares = [run["cpu_seconds"] / run["wall_seconds"] for run in members
                  if run["cpu_seconds"] is not None and (run["wall_seconds"] or 0) >= SHORTEST]  # fmt: skip
        if shares and min(shares) <= EVEN * max(shares):
            lines.append(
                f"{scene}: the trainings got {min(shares):.2f} to {max(shares):.2f} CPU seconds a second. Where they "
                "got less, other programs used the machine, or the option set leaves processors idle; compare CPU "
                "seconds, too."
            )
    for name in ("commit", "cpu", "gpu", "instruction_set", "threads"):
        values = {str(run["machine"].get(name)) for run in runs if run["machine"]}
        if len(values) > 1:
            lines.append(f"Trained with different {name}: {', '.join(sorted(values))}.")
    for row in rows:
        if row["failed_seeds"]:
            lines.append(f"{row['scene']} {row['config'] or ''}: means without failed seeds {row['failed_seeds']}.")
    return lines


def write_report(report: Mapping[str, Any], output: Path) -> None:
    """Write all files of the report into `output`."""
    shown = len({(run["scene"], run["config"]) for run in report["runs"]})
    each = max(1, min(OF_A_RUN, OF_A_REPORT // max(1, shown)))
    runs = _by_scene(report["runs"])
    pictures, drawn = {}, {}
    for scene in scenes_of(report):
        peers = [peer for peer in report["peers"] if peer["scene"] == scene]
        path, said = output / "figures" / f"{scene}_curves.png", "error of the test views against seconds of training"
        pictures[scene] = _figure(path, scene, "curves", said, draw_curves, runs[scene], peers)
        pictures[scene] += _views(output, scene, runs[scene], each)
    for scene, found in report["fronts"].items():
        names = list(dict.fromkeys(run["config"] for run in runs[scene]))
        path, said = output / "figures" / f"{scene}_fronts.png", "PSNR of each option set at its end, against seconds"
        drawn[scene] = _figure(path, scene, "fronts", f"{said}, Gaussians and megabytes", draw_fronts, found, names)
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


def _figure(path: Path, scene: str, what: str, said: str, draw: Callable[..., bool], *content: Any) -> list[Block]:
    """Draw a figure of a scene; return it as a block, none if there is nothing to draw."""
    try:
        return [{"picture": path, "text": f"{scene}: {said}"}] if draw(path, scene, *content) else []
    except ImportError as error:
        print(f"warning: no figure of {scene}'s {what}: matplotlib cannot be imported ({error})", file=sys.stderr)
        return []


def _views(output: Path, scene: str, runs: Sequence[Run], each: int) -> list[Block]:
    """Show views of each option set's first run that succeeded: the worst on a sheet, and up to `each` to compare."""
    blocks: list[Block] = []
    seen = set()
    for run in runs:
        if run["failure"] or run["config"] in seen:
            continue
        path = output / "figures" / f"{scene}{'_' + run['config'] if run['config'] else ''}_worst_views.png"
        try:
            if draw_worst_views(path, run, output):
                sheet = {"picture": path, "text": f"{run_title(run)}: the test views with the lowest PSNR"}
                blocks += [sheet, *comparisons(run, output, each)]
                seen.add(run["config"])
        except UserError as error:
            print(f"warning: no pictures of the test views of {run_title(run)}: {error}", file=sys.stderr)
    return blocks


def _timing(runs: Sequence[Run]) -> str:
    """Return the wall-clock minutes of train.py for each group of scenes, as text."""
    minutes: dict[str, float] = {}
    for run in runs:
        if run["wall_seconds"] is not None:
            minutes[run["group"]] = minutes.get(run["group"], 0.0) + run["wall_seconds"] / 60
    return "".join(f"{group}: {value:.2f} minutes\n" for group, value in minutes.items())
