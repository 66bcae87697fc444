"""The report for papers and programs: report.tex, tables that a plain article takes, and report.csv, a row a run."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any

from applications.evaluation.comparison import QUANTITIES
from applications.evaluation.tables import Table, make_result_tables
from splatting.records.renders import SCORES

SHOWN = (*SCORES, "seconds", "gaussians")  # as many as a column of text is wide
FACTS = ("group", "scene", "scenes", "config", "seed", "iteration", "apart", "failed", "model")  # columns before those
_CONSTANT = ("iteration", "seeds")  # columns that the caption replaces where all rows have the same
_RULES = ("toprule", "midrule", "bottomrule")  # of booktabs
_ESCAPES = {
    **{letter: f"\\{letter}" for letter in "#$%&_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$"},
    **{letter: f"${letter}$" for letter in "<>|"},  # which TeX's first font has only there
}


def format_csv(report: Mapping[str, Any]) -> str:
    """A line for each scored iteration of each run, and for each row of means. Names are those of report.json.

    A run without scores has a line, too. scenes: 1, or the number of scenes that a mean is over. failed: the stage.
    """
    lines = []
    for run in report["runs"]:
        scored = {int(number): values for number, values in run["iterations"].items() if values["views"]}
        facts = run | {"scenes": 1, "failed": run["failure"] and run["failure"]["stage"]}
        for iteration, values in (scored or {None: {}}).items():
            lines.append(facts | dict.fromkeys(QUANTITIES) | values | {"iteration": iteration})
    for mean in report["means"]:
        lines.append(mean | {name: mean[name]["mean"] for name in QUANTITIES})
    text = io.StringIO()
    writer = csv.DictWriter(text, (*FACTS, *QUANTITIES), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def format_tex(report: Mapping[str, Any]) -> str:
    r"""Tables to \input, with the lines of the package booktabs if the document loads it."""
    tables = make_result_tables([*report["summary"], *report["means"]], SHOWN)
    return "% \\input{report} in an article; finer lines with \\usepackage{booktabs}\n" + "".join(
        map(_format_table, tables)
    )


def _format_table(table: Table) -> str:
    """Write a table in LaTeX. Columns that are the same in all rows stand in its caption instead."""
    columns = list(zip(table.header, *table.rows, strict=True))
    same = [column for column in columns if column[0] in _CONSTANT and len(set(column[1:])) == 1]
    header, *rows = zip(*(column for column in columns if column not in same), strict=True)
    said = "".join(f", {name} {value}" for name, value, *_ in same)
    caption = f"Scores of the test views{said}."
    if any("±" in str(row) for row in rows):
        caption += " Means ± sample standard deviations over the seeds."
    lines = [_join_cells(row) for row in rows]
    if "options" in header:  # which stand below their scene
        lines, header = [], header[1:]
        for scene, of_scene in itertools.groupby(rows, key=lambda row: row[0]):
            lines += ["\\midrule"] if lines else []
            lines += [f"\\multicolumn{{{len(header)}}}{{l}}{{{_escape_tex(scene)}}} \\\\"]
            lines += [_join_cells(row[1:]) for row in of_scene]
    return "\n".join([
        "\\begin{table}", "\\footnotesize\\setlength{\\tabcolsep}{3pt}",
        *(f"\\providecommand{{\\{rule}}}{{\\hline}}" for rule in _RULES),
        f"\\caption{{{_escape_tex(f'{caption} {table.title}')}}}\\medskip",
        # A wide one stands in both margins.
        f"\\makebox[\\linewidth]{{\\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}",
        "\\toprule", _join_cells(header), "\\midrule", *lines, "\\bottomrule", "\\end{tabular}}", "\\end{table}", "",
    ])  # fmt: skip


def _join_cells(cells: Sequence[str]) -> str:
    return " & ".join(map(_escape_tex, cells)) + r" \\"


def _escape_tex(text: str) -> str:
    """A text as TeX shows it; letters that its first fonts lack appear as numbers."""
    plain = " ".join(text.split()).encode("latin-1", "backslashreplace").decode("latin-1")
    safe = "".join(_ESCAPES.get(x, x) for x in plain)
    safe = re.sub("-(?=-)", "-{}", safe)  # no dashes
    return "{}" + safe if safe[:1] in ("[", "*") else safe  # which would belong to the line before
