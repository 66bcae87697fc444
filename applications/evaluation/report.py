"""The report: report.json of all runs, its pages report.md and report.html, report.tex, report.csv, and figures."""

from __future__ import annotations

import base64
import functools
import io
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import numpy as np
from markupsafe import Markup

from applications.evaluation import comparison, tables
from applications.evaluation.figures import draw_cameras, draw_curves, draw_poses, draw_sizes
from applications.evaluation.gains import compute_gains
from applications.evaluation.paper import format_csv, format_tex
from groundwork.files.image_files import open_image
from groundwork.files.json_files import write_json
from groundwork.host.listing import markdown_table
from groundwork.host.machine import one_line
from scene.readers.info import from_above, up_of
from splatting.records.model_folder import json_or_none
from splatting.records.renders import GAIN, MASK_PICTURE, ComparedViews
from utils.system_utils import UserError, atomic_write

TITLE = "3D Gaussian Splatting: evaluation"
_WARNING = "warning: "  # before what a training said at its start
OF_A_RUN, OF_A_REPORT = 24, 96  # test views at most in the HTML file, at about 0.1 MB each
RESIZE_FILTER = "Pillow, bicubic, antialiased where it shrinks; 8-bit pictures"
_PHOTOGRAPHIC = 1 << 18  # bytes of a PNG above which a JPEG replaces it
_QUALITY = 90
_MEANT = re.compile(r"[\\`*\[\]<>&]")  # characters that begin or end Markdown's links, emphasis, code and HTML
_NUMBER = re.compile(r"[\d.,]*\d(e[+-]\d+)?")
_NAMED = 4  # trainings beside a line
_ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}

Run = dict[str, Any]
# By scene: paths of `cameras`, `curves`, `sizes`, `poses`, `masked`; `views`.
Pictures = Mapping[str, Mapping[str, Any]]


def make_report(
    command: Sequence[str],
    runs: Sequence[Run],
    peers: Sequence[dict[str, Any]] = (),
    earlier_commands: Sequence[Sequence[str]] = (),
) -> dict[str, Any]:
    """Make the content of report.json.

    command: words of the command line; runs: results of `results.read_run`; peers: as `error_curve.peers_of` returns
    them; earlier_commands: those of calls that made other runs.
    """
    runs = comparison.mark_apart(runs)
    scenes = list(comparison.group_by(runs, "scene"))
    rows = sorted(comparison.summarise(runs), key=lambda row: scenes.index(row["scene"]))
    means = comparison.average_scenes(rows)
    return {
        "gains": compute_gains(runs),
        "manifest": {
            "command": list(command),
            "earlier_commands": [list(words) for words in earlier_commands if list(words) != list(command)],
            "conventions": next((run["conventions"] for run in runs if run["conventions"]), {}),
            "resize_filter": RESIZE_FILTER,
        },
        "means": means,
        "peers": list(peers),
        "published": comparison.compare(runs, rows, means),
        "runs": runs,
        "summary": rows,
        "warnings": _list_warnings(runs, rows),
    }


def _list_warnings(runs: Sequence[Run], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the reasons why numbers of this report cannot be compared."""
    lines = []
    for scene, members in comparison.group_by(runs, "scene").items():
        if len({run["ground_truth_sha256"] for run in members} - {None}) > 1:
            apart = dict.fromkeys(run["config"] or "-" for run in members if run["apart"])
            lines.append(
                f"{scene}: the runs were scored on different ground truth (size, split, background or masks), so their "
                "scores and curves cannot be compared. Left out of comparisons: "
                f"{', '.join(apart)}."
            )
        if shares := comparison.find_uneven_shares(members):
            lines.append(
                f"{scene}: the trainings got {100 * shares[0]:.0f} to {100 * shares[1]:.0f} % of a processor. Where "
                "they got less, other programs used the machine, or the option set leaves processors idle; compare CPU "
                "seconds, too."
            )
    for name in ("commit", "cpu", "gpu", "instruction_set", "threads"):
        values = {str(run["machine"].get(name)) for run in runs if run["machine"]}
        if len(values) > 1:
            lines.append(f"Trained with different {name}: {', '.join(sorted(values))}.")
    said = ((run, line) for run in runs for line in run["lines"] or () if line.startswith(_WARNING))
    lines += dict.fromkeys(f"{_name_set(run)}: {line.removeprefix(_WARNING)}" for run, line in said)
    for row in rows:
        if row["failed_seeds"]:
            lines.append(f"{_name_set(row)}: means without failed seeds {row['failed_seeds']}.")
    return lines


def _name_set(row: Mapping[str, Any]) -> str:
    return " ".join(filter(None, (row["scene"], row["config"])))


def write_report(report: Mapping[str, Any], output: Path) -> None:
    """Write all files of the report into `output`."""
    runs = comparison.group_by(report["runs"], "scene")
    shown = len({(run["scene"], run["config"]) for run in report["runs"]})
    each = max(1, min(OF_A_RUN, OF_A_REPORT // max(1, shown)))
    pictures, folder = {}, output / "figures"
    for scene, members in runs.items():
        peers = [peer for peer in report["peers"] if peer["scene"] == scene]
        pictures[scene] = {
            "cameras": _draw_figures(draw_cameras, folder, scene, _find_cameras(output, members)),
            "curves": _draw_figures(draw_curves, folder, scene, members, peers),
            "poses": _draw_figures(draw_poses, folder, scene, members),
            "sizes": _draw_figures(draw_sizes, folder, scene, members),
            "masked": [path for run in members if (path := output / run["model"] / MASK_PICTURE).is_file()],
            "views": _show_views(output, scene, members, each),
        }
    texts = {f"report.{kind}": render(kind, report, pictures, output) for kind in ("md", "html")}
    texts |= {
        "report.csv": format_csv(report),
        "report.tex": format_tex(report),
        "timing.txt": _format_timing(report["runs"]),
    }
    write_json(output / "report.json", report)
    for name, text in texts.items():
        with atomic_write(output / name) as temporary:
            # Names that are not UTF-8 have surrogates, which appear as numbers.
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _find_cameras(output: Path, runs: Sequence[Run]) -> dict[str, list[np.ndarray]]:
    """Places and axes of the cameras in each split, for `draw_cameras`, of models whose cameras.json has them."""
    found: dict[str, list[np.ndarray]] = {}
    for run in runs:
        cameras, count = json_or_none(output / run["model"] / "cameras.json"), run["views"]["train"]
        try:
            places, turns = (np.array([camera[key] for camera in cameras]) for key in ("position", "rotation"))
            axes = from_above(up_of(turns)).T
            flat = np.c_[places @ axes, turns[:, :, 2] @ axes]
        except (KeyError, TypeError, ValueError, IndexError):
            continue
        if run["split"] and count is not None:
            found.setdefault(run["split"], np.split(flat, [len(flat) - count]))
    return found


def _draw_figures(draw: Callable[..., list[Path]], *content: Any) -> list[Path]:
    """Draw figures; return their files, none if there is nothing to draw."""
    try:
        return draw(*content)
    except ImportError as error:
        print(f"warning: no figures: matplotlib cannot be imported ({error})", file=sys.stderr)
        return []


def _show_views(output: Path, scene: str, runs: Sequence[Run], each: int) -> list[dict[str, Any]]:
    """Show views of each option set's first run that succeeded, side by side where the ground truth is the same.

    Of each ground truth: `sheet`, the file with the worst views; `shown`, up to `each` views; `several` option sets.
    """
    first: dict[str | None, Run] = {}
    for run in runs:
        if not run["failure"] and run["worst_views"]:
            first.setdefault(run["config"], run)
    groups = []
    for alike in comparison.group_by(first.values(), "ground_truth_sha256").values():
        name = f"{scene}_{alike[0]['config']}" if groups else scene
        path = output / "figures" / f"{name}_worst_views.png"
        try:
            views = ComparedViews(alike, output)
            views.draw_worst(path)
            groups.append({"sheet": path, "shown": views.shown(each), "several": len(alike) > 1,
                           "table": views.table()})  # fmt: skip
        except UserError as error:
            titles = "; ".join(map(name_run, alike))
            print(f"warning: no pictures of the test views of {titles}: {error}", file=sys.stderr)
    return groups


def _format_timing(runs: Sequence[Run]) -> str:
    """Return the wall-clock minutes of train.py for each group of scenes, as text."""
    timed = comparison.group_by((run for run in runs if run["wall_seconds"] is not None), "group")
    minutes = {group: sum(run["wall_seconds"] for run in members) / 60 for group, members in timed.items()}
    return "".join(f"{group}: {value:.2f} minutes\n" for group, value in minutes.items())


def name_run(run: Mapping[str, Any]) -> str:
    """Name a run by scene, option set and seed."""
    seed = None if run["seed"] is None else f"seed {run['seed']}"
    return ", ".join(part for part in (run["scene"], run["config"], seed) if part)


def render(kind: str, report: Mapping[str, Any], pictures: Pictures, folder: Path) -> str:
    """Render report.jinja as a page of a kind, "md" or "html". folder: of the page, for links."""
    scenes = comparison.group_by(report["runs"], "scene")
    make_environment(kind).globals["folder"] = folder
    text = make_environment(kind).get_template("report.jinja").render(
        facts=_collect_facts(report), form=f"page.{kind}.jinja", gain=GAIN, pictures=pictures, report=report,
        published=comparison.read_published(), scenes=scenes, tables=tables, title=TITLE,
    )  # fmt: skip
    return (re.sub(r"\n{2,}", "\n\n", text) if kind == "md" else text).strip() + "\n"


@functools.cache
def make_environment(kind: str) -> jinja2.Environment:
    """Make the jinja2 environment for a kind of page, "md" or "html". Its global `folder` is that of the page."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_escape if kind == "md" else None,
    )  # fmt: skip
    made.filters |= {
        "data_uri": _make_data_uri, "indented": _indent, "jpeg": _encode, "markdown": format_markdown,
        "no_list": _escape_start, "number": tables.format_number,
        "one_line": lambda text: Markup(" ".join(text.split())), "relative": _make_relative, "run_title": name_run,
        "url": lambda path: quote(os.fsencode(path)),
    }  # fmt: skip
    return made


@jinja2.pass_environment
def _make_relative(made: jinja2.Environment, path: Path) -> str:
    return os.path.relpath(path, made.globals["folder"])


def _collect_facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """Collect the facts that decide which remarks a page has."""
    rows, runs = report["summary"], report["runs"]

    def known(name: str, key: str = "mean") -> bool:
        return any(row[name][key] is not None for row in rows)

    return {
        "cpu_known": known("cpu_seconds"),
        "left_out": any(row["gaussians"]["mean"] != row["gaussians_saved"]["mean"] for row in rows),
        "machines": sorted({one_line(run["machine"]) for run in runs if run["machine"]}),
        "mipnerf360": any(run["group"] == "mipnerf360" for run in runs),
        "open_ended": any(row["open_ended"] for row in rows),
        "said": _list_closing_lines(runs),
        "several_seeds": known("PSNR", "std"),
        "timed": known("seconds"),
        "unfinished": [run for run in runs if not run["finished"] and not run["failure"]],
        "trainings": _count_trainings(runs),
        "without_lpips": bool(rows) and not known("LPIPS"),
    }


def _list_closing_lines(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """List the closing lines that only some trainings have, each with these trainings; lines may differ in numbers."""
    by_form: dict[str, dict[str, str]] = {}
    for run in runs:
        for line in run["lines"] or ():
            if not line.startswith(_WARNING):
                by_form.setdefault(_NUMBER.sub("", line.replace(run["model"], "")), {})[name_run(run)] = line
    said = []
    for lines in by_form.values():
        if len(lines) < len(runs):
            others = "" if len({*lines.values()}) == 1 else ", of which others have other numbers"
            more = f" and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
            said.append(("; ".join([*lines][:_NAMED]) + more, next(iter(lines.values())) + others))
    return said


def _count_trainings(runs: Sequence[Run]) -> str:
    """Say in a line how many trainings, scenes, option sets and seeds the report covers."""
    parts = [f"{len(runs)} training{'s' if len(runs) > 1 else ''}"]
    for key, name in (("scene", "scenes"), ("config", "option sets"), ("seed", "seeds")):
        if (count := len({run[key] for run in runs})) > 1:
            parts.append(f"{count} {name}")
    return ", ".join(parts)


def _make_data_uri(path: Path) -> str:
    """Return a figure as a data: URI; large ones become JPEG."""
    content = path.read_bytes()
    if len(content) <= _PHOTOGRAPHIC:
        return _encode(content, "png")
    buffer = io.BytesIO()
    with open_image(path) as image:
        image.convert("RGB").save(buffer, "JPEG", quality=_QUALITY)
    return _encode(buffer.getvalue())


def _encode(content: bytes, kind: str = "jpeg") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def format_markdown(table: tables.Table) -> Markup:
    """A table in Markdown, its cells escaped."""
    header, *rows = [[str(_escape(cell)) for cell in row] for row in (table.header, *table.rows)]
    return Markup(markdown_table(header, rows))


def _escape(text: Any) -> Markup:
    """Escape a text for Markdown, so that names in it appear as they are: no link, no HTML, no second line."""
    if isinstance(text, Markup):
        return text
    safe = _MEANT.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), str(text))
    return Markup(" ".join(safe.splitlines()))


def _escape_start(text: str) -> Markup:
    """Escape the start of a paragraph, so that Markdown takes it for no heading and no list."""
    return Markup(re.sub(r"^\s*([#+=~-])", r"\\\1", text))


def _indent(texts: Sequence[str]) -> Markup:
    """Indent the lines of texts by four spaces, as Markdown shows code."""
    return Markup("\n".join(f"    {line}" for text in texts for line in text.splitlines()))
